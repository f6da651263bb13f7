#pragma once

#include "math/types.hpp"

/// Motion of a rigid body over one step when nothing touches it: implicit Euler in momentum form.
namespace diffsim {

struct FreeRotation {
    Vec3 angular_velocity;  ///< at the end of the step [rad/s]
    Vec3 rotation;          ///< rotation vector of the whole step, R1 = Exp(rotation) R0 [rad]
    int substeps = 1;       ///< 0: too many would be needed; the body keeps its orientation and angular velocity
};

/// Solve I(R1) w1 = I(R0) w0 + dt torque with R1 = Exp(dt w1) R0 and I(R) = R I_b Rᵀ, so that angular
/// momentum in free flight is kept to rounding. Where dt |w| exceeds one radian, where the equation
/// need not have one solution, the step is cut into equal substeps, the torque's impulse given at the
/// start; the rotation is then the logarithm of the product, shorter than half a turn.
FreeRotation free_rotation(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt);

struct FreeRotationGradient {
    Vec3 orientation = Vec3::Zero();  ///< rotation covector of R0
    Vec3 angular_velocity = Vec3::Zero();
    Vec3 torque = Vec3::Zero();
    Mat3 inertia_body = Mat3::Zero();  ///< symmetric
};

/// Gradient of a loss with gradients grad_angular_velocity and grad_rotation at the
/// result; of the inertia if asked for.
FreeRotationGradient free_rotation_backward(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt,
    const FreeRotation& result, const Vec3& grad_angular_velocity, const Vec3& grad_rotation, bool with_inertia);

/// Rotation covector, at R, of covector · (R I_b Rᵀ w) with covector, w and I_b held fixed:
/// d(I w) = phi x (I w) - I (phi x w).
Vec3 inertia_rotation_gradient(const Mat3& inertia_world, const Vec3& w, const Vec3& covector);

/// Gradient with respect to symmetric I_b of covector · (R I_b Rᵀ w).
Mat3 inertia_body_gradient(const Mat3& R, const Vec3& w, const Vec3& covector);

}  // namespace diffsim
