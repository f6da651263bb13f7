#pragma once

#include "dynamics/free_motion.hpp"

/// Turn of a rigid body over one step when nothing touches it: the midpoint scheme of [simo1991unconditionally], of
/// second order, symmetric in time, which keeps energy and spatial angular momentum.
namespace diffsim {

/// Solve I(R0) u = R0 R1ᵀ (I(R0) w0 + dt torque) with R1 = Exp(dt (w0 + u) / 2) R0 and I(R) = R I_b Rᵀ; then
/// w1 = R1 R0ᵀ u. That is I(R1) w1 = I(R0) w0 + dt torque, and without torque w1·I w1 = w0·I w0, as the turn leaves its
/// own axis alone. Where dt |w| exceeds one radian the step is cut into equal substeps, each with its part of the
/// torque's impulse; the rotation is then the logarithm of the product, shorter than half a turn.
FreeRotation conserving_rotation(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt);

/// Gradient of a loss with gradients grad_angular_velocity and grad_rotation at the
/// result; of the inertia if asked for.
FreeRotationGradient conserving_rotation_backward(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt,
    const FreeRotation& result, const Vec3& grad_angular_velocity, const Vec3& grad_rotation, bool with_inertia);

}  // namespace diffsim
