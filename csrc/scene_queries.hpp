#pragma once

#include "model/state.hpp"
#include "step.hpp"

/// Questions about a state that no step asks.
namespace diffsim {

/// The state with dynamic bodies that touch, or are nearer than they rest, moved apart (contact/separation.hpp).
SceneState separate_state(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state);

/// The first two objects, by index, whose meshes cross and that a step would have to keep apart; kNobody if there are none.
struct CrossingObjects {
    int a = kNobody, b = kNobody;
};
CrossingObjects find_crossing(const Model& model, const SceneState& state);

/// Smallest distance between the collision surfaces of any two objects, at least one of which is dynamic or kinematic.
struct NearestObjects {
    double distance = kInfinity;
    int a = kNobody, b = kNobody;
};
NearestObjects nearest_objects(const Model& model, const SceneState& state);

}  // namespace diffsim
