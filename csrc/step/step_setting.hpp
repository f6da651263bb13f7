#pragma once

#include <vector>

#include "model/model.hpp"

/// What the schemes of bodies and cloths are given beside states and controls, and the gradients that they add to.
namespace diffsim {

struct StepSetting {
    const Model& model;
    const Parameters& parameters;
    double dt;      ///< [s]
    StepPart part;  ///< of the step

    /// For how long forces have acted on the velocity that a free body moves with [s]: the whole step, or the half of
    /// it after which the velocity is the mean one.
    double acceleration_time() const { return part == StepPart::places ? 0.5 * dt : dt; }
    /// See ZoneBody::weight.
    double body_weight() const { return part == StepPart::places ? 2.0 : 1.0; }
};

/// d(loss)/d(Parameters): as many entries, of friction none where there is none.
using ParameterGradient = Parameters;

/// Numbers whose squares are larger count as overflown, be it on the way or in a state: what is computed from smaller
/// ones is finite, and so it is where single precision is asked for.
inline constexpr double kLargestSquare = 1e76;

}  // namespace diffsim
