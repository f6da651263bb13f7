#pragma once

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>

#include "math/rotation.hpp"

/// What the schemes of free rotation have in common: how a step is cut, and where Newton's method begins.
namespace diffsim {

inline constexpr double kMaxAnglePerSubstep = 1.0;  // [rad]; Newton converges from w0 for any inertia we tried
inline constexpr int kMaxSubsteps = 1 << 20;
inline constexpr int kMaxNewtonSteps = 30;
inline constexpr double kMaxTurn = 3.0;  // of a substep [rad]; short of half a turn, from where on another is the same

/// Substeps of a step in which a body turns by this much [rad].
inline int substeps_for(double angle) {
    return static_cast<int>(std::min(std::ceil(std::max(angle / kMaxAnglePerSubstep, 1.0)), 1.0 * kMaxSubsteps));
}

inline Vec3 initial_guess(const Mat3& inertia_world, const Vec3& angular_velocity, const Vec3& torque, double dt) {
    if (torque.isZero(0.0)) return angular_velocity;
    return angular_velocity + inertia_world.llt().solve(dt * torque);
}

/// Newton's method from a guess, run until rounding stops it: the best of its iterates. evaluate(unknown, iterate)
/// fills one in and returns its residual, a difference of numbers of size `scale`, one of which is the momentum;
/// jacobian(iterate) is the residual's.
template <typename Substep, typename Evaluate, typename Jacobian>
Substep newton_substep(
    const Vec3& guess, const Vec3& momentum, double scale, const Evaluate& evaluate, const Jacobian& jacobian) {
    Substep best;
    double best_residual = kInfinity;
    Vec3 unknown = guess;
    for (int k = 0; k < kMaxNewtonSteps; ++k) {
        Substep iterate;
        const Vec3 residual = evaluate(unknown, iterate);
        const double norm = residual.norm();
        if (!(norm < best_residual)) break;
        best = iterate;
        best_residual = norm;
        if (norm <= 0.5 * kEpsilon * momentum.norm()) break;
        unknown -= jacobian(iterate).partialPivLu().solve(residual);
    }
    best.converged =
        std::isfinite(best_residual) && best_residual <= 16.0 * kEpsilon * scale && best.rotation.norm() < kMaxTurn;
    return best;
}

/// Through rotation = log(R1 R0ᵀ): a turn phi of R1 moves it by J⁻¹ phi, a turn of R0 by -J⁻¹ Exp phi. Returns the
/// covector of R1 and takes that of R0 from `of_start`.
inline Vec3 log_rotation_backward(const Vec3& rotation, const Vec3& grad_rotation, Vec3& of_start) {
    const Vec3 covector = left_jacobian(rotation).transpose().partialPivLu().solve(grad_rotation);
    of_start -= exp_rotation(rotation).transpose() * covector;
    return covector;
}

}  // namespace diffsim
