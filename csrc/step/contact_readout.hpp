#pragma once

#include <array>
#include <vector>

#include "step/step.hpp"

/// The contacts of a step that was taken, for those who look at them or differentiate their forces.
namespace diffsim {

/// A contact that pushed at the end of a step. World frame.
struct ContactReadout {
    /// One object's part: its closest point, and along what that slides on its feature when objects move.
    struct Side {
        int object = kGround;  ///< as in Contact
        Vec3 point = Vec3::Zero();
        int slide_count = 0;
        std::array<Vec3, 2> slides = {Vec3::Zero(), Vec3::Zero()};
        Vec3 edge = Vec3::Zero();  ///< of two edges this one, from end to end; zero of other features
        // Of cloth: nodes of the model, -1 fills the rest; the point is their weighted sum, so are the slides.
        std::array<int, 3> nodes = {-1, -1, -1};
        Vec3 weights = Vec3::Zero();
        std::array<Vec3, 2> slide_weights = {Vec3::Zero(), Vec3::Zero()};
        double mass_exponent = 0.0;  ///< d(log stiffness)/d(log mass) of the object
    };
    std::array<Side, 2> sides;
    Vec3 normal = Vec3::Zero();    ///< unit, from the second object to the first
    double distance = 0.0;         ///< between the bare meshes [m]
    double sine_sq = 1.0;          ///< of the angle between two edges, which the force is mollified by
    Vec3 friction = Vec3::Zero();  ///< on the first object, across the normal [N]
    bool sticks = false;           ///< it has friction and does not slip
    double force = 0.0;            ///< on the first object, along the normal [N]
    double stiffness = 0.0;        ///< -d(force)/d(distance); meaningless where contacts are hard [N/m]
};

/// Those of a step. In the order of its record: zone by zone, then by objects and features.
std::vector<ContactReadout> read_contacts(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record);

}  // namespace diffsim
