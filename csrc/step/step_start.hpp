#pragma once

#include "dynamics/free_motion.hpp"
#include "geometry/box.hpp"
#include "model/state.hpp"
#include "zone/zone.hpp"

/// Bodies and cloths at the start of a step.
namespace diffsim {

/// A dynamic body at the start of a step, in the world frame: with R0 I_b R0ᵀ, the motion nothing hinders as target and
/// last step's motion as warm start.
ZoneBody moving_body(
    int id, const BodyState& state, const BodyControl& control, const Parameters& parameters,
    const FreeRotation& rotation, double dt);

/// Append a cloth at the start of a step to a zone, whose origin and dt are set.
void add_cloth(Zone& zone, int id, const SceneState& state, const SceneControl& control, const Parameters& parameters);

/// Velocity at the end of a step in which nothing touches the body: v0 + dt (g + f / m).
inline Vec3 free_velocity(
    int id, const BodyState& state, const BodyControl& control, const Parameters& parameters, double dt) {
    return state.velocity + dt * (parameters.gravity + control.force / parameters.mass[id]);
}

/// The same for a cloth node of this mass that nothing touches, not even its neighbours.
inline Vec3 free_node_velocity(
    const Vec3& velocity, const Vec3& force, double mass, const Parameters& parameters, double dt) {
    return velocity + dt * (parameters.gravity + force / mass);
}

/// Space for a dynamic body from where it is to where it went (`warm`) or would go: world frame, margins included.
Box space_of_body(const Model& model, const ZoneBody& body);
/// For a body that moves as told, by `motion`.
Box space_of_driven_body(const Model& model, int id, const Pose& start, const Vec6& motion);
/// For the nodes of a cloth. `thickness` is its own.
Box space_of_cloth(
    const Cloth& cloth, const SceneState& state, const SceneControl& control, const Parameters& parameters,
    double thickness, double dt);

}  // namespace diffsim
