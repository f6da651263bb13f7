#pragma once

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>

#include "math/types.hpp"

/// What the schemes of free rotation have in common: how a step is cut, and where Newton's method begins.
namespace diffsim {

inline constexpr double kMaxAnglePerSubstep = 1.0;  // [rad]; Newton converges from w0 for any inertia we tried
inline constexpr int kMaxSubsteps = 1 << 20;
inline constexpr int kMaxNewtonSteps = 30;

/// Substeps of a step in which a body turns by this much [rad].
inline int substeps_for(double angle) {
    return static_cast<int>(std::min(std::ceil(std::max(angle / kMaxAnglePerSubstep, 1.0)), 1.0 * kMaxSubsteps));
}

inline Vec3 initial_guess(const Mat3& inertia_world, const Vec3& angular_velocity, const Vec3& torque, double dt) {
    if (torque.isZero(0.0)) return angular_velocity;
    return angular_velocity + inertia_world.llt().solve(dt * torque);
}

}  // namespace diffsim
