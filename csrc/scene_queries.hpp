#pragma once

#include "model/state.hpp"
#include "step/step.hpp"

/// Questions about a state that no step asks.
namespace diffsim {

/// The state with dynamic bodies that touch, or are nearer than they rest, moved apart (contact/separation.hpp). Throws
/// std::invalid_argument, naming the pair, where meshes cross or there is no room.
SceneState separate_state(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state);

/// The first two objects, by index, whose meshes cross and that a step would have to keep apart, the same one twice for
/// a cloth that crosses itself; kNobody if there are none. O(n log n) in the features unless many boxes overlap.
struct CrossingObjects {
    int a = kNobody, b = kNobody;
};
CrossingObjects find_crossing(const Model& model, const SceneState& state);

/// Smallest distance between the collision surfaces of any two objects of which a step can move one apart from the
/// other, a dynamic body or a cloth, or of a cloth with itself. There, as contacts do, features that share a node do
/// not count, and of two that are nearer at rest than the cloth is thick, half their distance at rest takes the
/// margins' place (contact_margins).
struct NearestObjects {
    double distance = kInfinity;
    int a = kNobody, b = kNobody;
};
NearestObjects nearest_objects(const Model& model, const SceneState& state);

}  // namespace diffsim
