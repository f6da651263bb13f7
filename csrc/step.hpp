#pragma once

#include <cstdint>
#include <vector>

#include "contact/zone_solver.hpp"
#include "dynamics/free_motion.hpp"
#include "model/state.hpp"

/// One time step and its backward: the only place that knows the whole order.
namespace diffsim {

/// What the backward of a step needs: O(bodies + contacts).
struct StepRecord {
    SceneState start;
    std::vector<FreeRotation> free_rotation;  ///< one per body
    Coordinates y;                            ///< one per body: the motion (turn, shift) of the step
    /// Dynamic bodies in contact, zone after zone, and the active contacts of each zone.
    std::vector<int> zone_bodies, zone_body_end, zone_contact_end;
    std::vector<Contact> contacts;

    std::size_t bytes() const;
};

struct StepInfo {
    bool converged = true;
    ZoneStatus status = ZoneStatus::converged;  ///< of the first zone that did not converge
    int contacts = 0;
    int zones = 0;         ///< groups of bodies in contact
    int largest_zone = 0;  ///< bodies
    int iterations = 0;    ///< Newton steps of the zone that took most
    double residual = 0.0;
    double max_compression = 0.0;  ///< of a contact below its rest distance [m]
    double seconds_motion = 0.0, seconds_broad_phase = 0.0, seconds_zones = 0.0;
    std::uint64_t signature = 0;  ///< hash of the active contacts and their types
};

/// Memory that steps reuse. One per thread.
struct StepWorkspace {
    ZoneWorkspace zone;
    std::vector<Box> boxes, visited;
};

/// Advance by options.dt. `record`, if given, receives what step_backward needs; it does not change the result.
/// Throws std::invalid_argument if objects are nearer than their pole at the start.
SceneState step(const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
                const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record);

/// d(loss)/d(BodyControl).
using BodyControlGradient = BodyControl;

struct ParameterGradient {
    std::vector<double> mass;
    std::vector<Mat3> inertia;
    Vec3 gravity = Vec3::Zero();
};

/// Carry the gradient at the end of a step back to its start. `gradient` is overwritten; control and parameter
/// gradients are added to. `wants_inertia` false skips what only the inertia needs.
void step_backward(const Model& model, const Options& options, const Parameters& parameters,
                   const SceneControl& control, const StepRecord& record, StepWorkspace& workspace,
                   std::vector<BodyStateGradient>& gradient, std::vector<BodyControlGradient>& control_gradient,
                   ParameterGradient& parameter_gradient);

/// The state with dynamic bodies that touch, or are nearer than they rest, moved apart (contact/separation.hpp).
SceneState separate_state(const Model& model, const Options& options, const Parameters& parameters,
                          const SceneState& state);

/// Smallest distance between the collision surfaces of any two objects, at least one of which is dynamic or kinematic.
struct NearestObjects {
    double distance = kInfinity;
    int a = kNobody, b = kNobody;
};
NearestObjects nearest_objects(const Model& model, const SceneState& state);

}  // namespace diffsim
