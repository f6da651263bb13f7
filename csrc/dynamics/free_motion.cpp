#include "dynamics/free_motion.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cassert>
#include <cmath>
#include <vector>

#include "dynamics/substeps.hpp"
#include "math/rotation.hpp"

namespace diffsim {
namespace {

struct Substep {
    Vec3 angular_velocity;
    Mat3 turn, R1;       ///< R1 = turn R0 at its end
    Mat3 inertia_world;  ///< at R1
    bool converged = false;
};

/// d(I(R1) w)/dw with R1 = Exp(dt w) R0, given the left Jacobian at dt w.
Mat3 momentum_jacobian(const Substep& substep, double dt, const Mat3& jacobian) {
    const Vec3& w = substep.angular_velocity;
    const Mat3& inertia = substep.inertia_world;
    return inertia + dt * (inertia * skew(w) - skew(inertia * w)) * jacobian;
}

/// Newton's method on I(Exp(dt w) R0) w = momentum from the guess w, run until rounding stops it.
Substep solve_substep(const Mat3& R0, const Vec3& guess, const Vec3& momentum, const Mat3& inertia_body, double dt) {
    Substep best;
    double best_residual = kInfinity;
    Vec3 w = guess;
    const double scale = std::max(momentum.norm(), inertia_body.norm() * guess.norm());  // of the numbers subtracted
    for (int k = 0; k < kMaxNewtonSteps; ++k) {
        Substep trial;
        trial.angular_velocity = w;
        trial.turn = exp_rotation(dt * w);
        trial.R1 = trial.turn * R0;
        trial.inertia_world = trial.R1 * inertia_body * trial.R1.transpose();
        const Vec3 residual = trial.inertia_world * w - momentum;
        const double norm = residual.norm();
        if (!(norm < best_residual)) break;
        best = trial;
        best_residual = norm;
        if (norm <= 0.5 * kEpsilon * momentum.norm()) break;
        w -= momentum_jacobian(trial, dt, left_jacobian(dt * w)).partialPivLu().solve(residual);
    }
    best.converged = std::isfinite(best_residual) && best_residual <= 16.0 * kEpsilon * scale &&
                     dt * best.angular_velocity.norm() < 3.0;
    return best;
}

/// The whole step in a given number of substeps; empty if one of them did not converge.
std::vector<Substep> solve_substeps(
    const Mat3& R0, const Vec3& guess, const Vec3& momentum, const Mat3& inertia_body, double dt, int count) {
    std::vector<Substep> substeps;
    substeps.reserve(static_cast<std::size_t>(count));
    Mat3 R = R0;
    Vec3 w = guess;
    for (int k = 0; k < count; ++k) {
        substeps.push_back(solve_substep(R, w, momentum, inertia_body, dt / count));
        if (!substeps.back().converged) return {};
        R = substeps.back().R1;
        w = substeps.back().angular_velocity;
    }
    return substeps;
}

}  // namespace

FreeRotation free_rotation(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt) {
    if (angular_velocity.isZero(0.0) && torque.isZero(0.0)) return {Vec3::Zero(), Vec3::Zero(), 1};
    const Mat3 inertia_world = R0 * inertia_body * R0.transpose();
    const Vec3 momentum = inertia_world * angular_velocity + dt * torque;
    const Vec3 guess = initial_guess(inertia_world, angular_velocity, torque, dt);
    const double angle = dt * std::max(angular_velocity.norm(), guess.norm());
    int count = substeps_for(angle);
    if (count == 1) {
        const Substep single = solve_substep(R0, guess, momentum, inertia_body, dt);
        if (single.converged) return {single.angular_velocity, dt * single.angular_velocity, 1};
        count = 2;
    }
    for (; count <= kMaxSubsteps; count *= 2) {
        const std::vector<Substep> substeps = solve_substeps(R0, guess, momentum, inertia_body, dt, count);
        if (substeps.empty()) continue;
        return {substeps.back().angular_velocity, log_rotation(substeps.back().R1 * R0.transpose()), count};
    }
    return {angular_velocity, Vec3::Zero(), 0};
}

Vec3 inertia_rotation_gradient(const Mat3& inertia_world, const Vec3& w, const Vec3& covector) {
    return (inertia_world * w).cross(covector) - w.cross(inertia_world * covector);
}

Mat3 inertia_body_gradient(const Mat3& R, const Vec3& w, const Vec3& covector) {
    const Mat3 outer = (R.transpose() * covector) * (R.transpose() * w).transpose();
    return 0.5 * (outer + outer.transpose());
}

FreeRotationGradient free_rotation_backward(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt,
    const FreeRotation& result, const Vec3& grad_angular_velocity, const Vec3& grad_rotation, bool with_inertia) {
    FreeRotationGradient grad;
    if (result.substeps == 0) {  // held
        grad.angular_velocity = grad_angular_velocity;
        return grad;
    }
    const Mat3 inertia0 = R0 * inertia_body * R0.transpose();
    const Vec3 momentum = inertia0 * angular_velocity + dt * torque;
    Substep single;  // the one substep of most bodies needs no heap
    std::vector<Substep> several;
    if (result.substeps == 1) {
        single.angular_velocity = result.angular_velocity;
        single.turn = exp_rotation(dt * result.angular_velocity);
        single.R1 = single.turn * R0;
        single.inertia_world = single.R1 * inertia_body * single.R1.transpose();
    } else {
        const Vec3 guess = initial_guess(inertia0, angular_velocity, torque, dt);
        several = solve_substeps(R0, guess, momentum, inertia_body, dt, result.substeps);
        assert(!several.empty());  // as in the forward
    }
    const Substep* substeps = several.empty() ? &single : several.data();
    const std::size_t count = several.empty() ? 1 : several.size();

    const double dt_sub = dt / static_cast<double>(count);
    Vec3 grad_w = grad_angular_velocity;
    Vec3 covector = Vec3::Zero();  // of the orientation at the end of the substep at hand
    if (result.substeps == 1) {
        grad_w += dt * grad_rotation;
    } else {
        // rotation = log(R1 R0ᵀ): a turn phi of R1 moves it by J⁻¹ phi, a turn of R0 by -J⁻¹ Exp phi.
        covector = left_jacobian(result.rotation).transpose().partialPivLu().solve(grad_rotation);
        grad.orientation -= exp_rotation(result.rotation).transpose() * covector;
    }
    Vec3 grad_momentum = Vec3::Zero();
    for (std::size_t k = count; k-- > 0;) {
        const Substep& substep = substeps[k];
        const Vec3& w = substep.angular_velocity;
        const Mat3 jacobian = left_jacobian(dt_sub * w);
        grad_w += dt_sub * jacobian.transpose() * covector;
        const Vec3 multiplier = momentum_jacobian(substep, dt_sub, jacobian).transpose().partialPivLu().solve(grad_w);
        grad_momentum += multiplier;
        if (with_inertia) grad.inertia_body -= inertia_body_gradient(substep.R1, w, multiplier);
        covector =
            substep.turn.transpose() * (covector - inertia_rotation_gradient(substep.inertia_world, w, multiplier));
        grad_w.setZero();
    }
    grad.orientation += covector + inertia_rotation_gradient(inertia0, angular_velocity, grad_momentum);
    grad.angular_velocity = inertia0 * grad_momentum;
    grad.torque = dt * grad_momentum;
    if (with_inertia) grad.inertia_body += inertia_body_gradient(R0, angular_velocity, grad_momentum);
    return grad;
}

}  // namespace diffsim
