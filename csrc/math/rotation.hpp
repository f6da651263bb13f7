#pragma once

#include "math/types.hpp"

/// Rotations and their derivatives. Quaternions are (w, x, y, z). A rotation is perturbed from the
/// left, in the world frame: R -> Exp(phi) R. "Rotation covector" names the gradient with respect to
/// that phi.
namespace diffsim {

/// Matrix of the cross product: skew(a) b = a x b.
inline Mat3 skew(const Vec3& a) {
    Mat3 m;
    m << 0.0, -a.z(), a.y(), a.z(), 0.0, -a.x(), -a.y(), a.x(), 0.0;
    return m;
}

/// Rotation matrix of a rotation vector [rad].
Mat3 exp_rotation(const Vec3& theta);

/// Unit quaternion of a rotation vector [rad].
Vec4 exp_quaternion(const Vec3& theta);

/// Rotation vector of a rotation matrix, angle in [0, pi].
Vec3 log_rotation(const Mat3& rotation);

/// Left Jacobian J of the exponential map: Exp(theta + d) = Exp(J d) Exp(theta) to first order in d.
Mat3 left_jacobian(const Vec3& theta);

/// Derivative with respect to theta of J(theta)^T tau, tau held fixed.
Mat3 left_jacobian_transposed_derivative(const Vec3& theta, const Vec3& tau);

/// Matrix of a unit quaternion.
Mat3 quaternion_to_matrix(const Vec4& q);

/// Hamilton product a b.
Vec4 quaternion_multiply(const Vec4& a, const Vec4& b);

/// Rotation covector of a loss whose gradient with respect to the four numbers of the unit
/// quaternion q is grad_q: phi moves q by dq = 1/2 (0, phi) q.
Vec3 quaternion_gradient_to_covector(const Vec4& q, const Vec4& grad_q);

/// Gradient with respect to the four numbers of q, for a loss that depends on q / |q| only and has
/// this rotation covector there. It is orthogonal to q.
Vec4 covector_to_quaternion_gradient(const Vec4& q, const Vec3& covector);

}  // namespace diffsim
