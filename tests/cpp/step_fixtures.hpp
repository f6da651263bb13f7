// Scenes that are advanced by one step, for the tests of the step and of its backward.
#pragma once

#include <vector>

#include "cloth_fixtures.hpp"
#include "step/step.hpp"

namespace fixtures::steps {

inline constexpr double kDt = 0.01;         // [s]
inline constexpr double kThickness = 1e-3;  // [m]

/// Everything a step depends on.
struct Scene {
    Model model;
    Options options;
    Parameters parameters;
    SceneState state;
    SceneControl control;

    Scene();
    int add(Body body, const Vec3& position, const Vec3& turn, double mass, const Mat3& inertia);
    int add_box(
        const Vec3& half, const Vec3& position, const Vec3& turn = Vec3::Zero(), BodyKind kind = BodyKind::dynamic,
        double mass = 2.0);
    int add_ball(double radius, const Vec3& position, double mass);
    /// A sheet at these nodes, in the metric and with the damping of its rest shape.
    int add_cloth(
        const fixtures::TriangleMesh& rest, const std::vector<Vec3>& nodes, const std::vector<int>& pinned,
        const ClothParameters& material = {0.3, 900.0, 300.0, 1e-3, 0.01});
    void add_ground() { model.ground = {true, 0.0, 0.5 * kThickness}; }

    SceneState step(StepInfo& info, StepRecord* record = nullptr) const;
    SceneState step() const;
};

Scene tumbling();
Scene tilted_landing();
Scene free_collision();
Scene pushed_ball();

}  // namespace fixtures::steps
