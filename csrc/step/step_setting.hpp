#pragma once

#include <vector>

#include "dynamics/two_stages.hpp"
#include "model/model.hpp"

/// What the schemes of bodies and cloths are given beside states and controls, and the gradients that they add to.
namespace diffsim {

struct StepSetting {
    const Model& model;
    const Parameters& parameters;
    double dt;      ///< [s]
    StepPart part;  ///< of the step
    /// Where nodes were at the end of the first stage, in a part that comes after one; else empty or null.
    const std::vector<Vec3>* first_stage = nullptr;
    /// Of nodes at the end, where a part for velocities found them: the search for places begins there. Else empty or
    /// null.
    const std::vector<Vec3>* end_velocity = nullptr;

    /// Whether this solve is a step of implicit Euler over dt.
    bool by_implicit_euler() const { return part == StepPart::whole || part == StepPart::first_stage; }
    /// Whether nodes move by the second of two stages.
    bool after_first_stage() const { return first_stage != nullptr && !first_stage->empty(); }

    /// For how long forces have acted on the velocity that a free body moves with [s]: the whole step, or the half of
    /// it after which the velocity is the mean one.
    double acceleration_time() const { return part == StepPart::places ? 0.5 * dt : dt; }
    /// See ZoneBody::weight: what forces do to places is dt² f / (weight m).
    double body_weight() const { return part == StepPart::places ? 2.0 : 1.0; }
    double node_weight() const { return part == StepPart::places && after_first_stage() ? 1.0 / kStage : 1.0; }
};

/// d(loss)/d(Parameters): as many entries, of friction none where there is none.
using ParameterGradient = Parameters;

/// Numbers whose squares are larger count as overflown, be it on the way or in a state: what is computed from smaller
/// ones is finite, and so it is where single precision is asked for.
inline constexpr double kLargestSquare = 1e76;

}  // namespace diffsim
