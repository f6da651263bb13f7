#pragma once

#include "adjoint/adjoint.hpp"
#include "dynamics/free_motion.hpp"
#include "geometry/box.hpp"
#include "model/state.hpp"
#include "step/step_setting.hpp"
#include "zone/zone.hpp"

/// The time scheme of one rigid body: how its step begins, how it ends, and the backward of both. Implicit Euler:
/// momentum form for turns (dynamics/free_motion.hpp), the velocity at the end of the step for shifts.
/// Trapezoidal, by the part of the step: velocities as implicit Euler has them but for
/// dynamics/conserving_rotation.hpp, places by mean velocities.
namespace diffsim {

/// A body at the start of a step.
struct BodyStart {
    FreeRotation rotation{Vec3::Zero(), Vec3::Zero(), 1};
    ZoneBody body;               ///< of a dynamic one, in the world frame
    Vec6 motion = Vec6::Zero();  ///< (turn, shift) when nothing hinders it: where it goes by itself, or is driven
};
BodyStart begin_body(const StepSetting& setting, int id, const BodyState& state, const BodyControl& control);

/// A dynamic body at the start of a step, in the world frame: with R0 I_b R0ᵀ, the motion nothing hinders as target and
/// last step's motion.
ZoneBody moving_body(
    const StepSetting& setting, int id, const BodyState& state, const BodyControl& control,
    const FreeRotation& rotation);

/// The state after the motion `y`. `start`: of this step. `as_told`: a driven body was not held up, and
/// has the velocity it was given.
BodyState end_body(
    const StepSetting& setting, const BodyStart& start, int id, const BodyState& state, const BodyControl& control,
    const Vec6& y, bool as_told);

/// An orientation after a turn.
Vec4 turned(const Vec4& orientation, const Vec3& turn);

/// Space for a dynamic body from where it is to where it went in the last step or would go:
/// world frame, margins included.
Box space_of_body(const Model& model, const ZoneBody& body);
/// For a body that moves as told, by `motion`.
Box space_of_driven_body(const Model& model, int id, const Pose& start, const Vec6& motion);

/// Whether a body's motion or place is too large for numbers to hold: velocities are the motion over dt.
bool body_overflows(const BodyState& state, const Vec6& motion, double dt);

// --- backward

/// d(loss)/dy of a body through its state at the end of the step.
Vec6 body_upstream(const BodyStateGradient& end, const Vec6& y, double dt);

/// What came back to a body through its zone.
struct BodyAdjoint {
    bool in_zone;            ///< it touched something; otherwise it has no multiplier
    const Vec6& multiplier;  ///< z
    const Vec6& pose;        ///< along its twist at the end of the step
    const Vec6& drive;       ///< of a driven one, through slips: along its motion, its pose at the end held
};

/// Carry the gradient at the end of a step back to its start: `gradient` is overwritten, the others are added to.
/// `state`, `rotation`: of the start.
void body_backward(
    const StepSetting& setting, int id, const BodyState& state, const BodyControl& control,
    const FreeRotation& rotation, const Vec6& y, const BodyAdjoint& adjoint, const GradientNeeds& needs,
    BodyStateGradient& gradient, BodyControl& control_gradient, ParameterGradient& parameter_gradient);

}  // namespace diffsim
