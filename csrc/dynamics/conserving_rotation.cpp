#include "dynamics/conserving_rotation.hpp"

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

struct ConservingSubstep {
    Mat3 R0, inertia;  ///< at its start, the inertia in the world frame
    Vec3 momentum;     ///< at its end
    Vec3 u;            ///< angular velocity at its end, turned back to its start
    Vec3 rotation;
    Mat3 turn;  ///< Exp(rotation)
    bool converged = false;
};

/// d(I u - Exp(-dt (w0 + u) / 2) momentum)/du, given the left Jacobian at the rotation.
Mat3 conserving_jacobian(const ConservingSubstep& substep, double dt, const Mat3& jacobian) {
    return substep.inertia - 0.5 * dt * (substep.turn.transpose() * skew(substep.momentum) * jacobian);
}

/// I(R0) u = Exp(-dt (w0 + u) / 2) momentum from the guess u.
ConservingSubstep solve_conserving_substep(
    const Mat3& R0, const Vec3& w0, const Vec3& guess, const Vec3& momentum, const Mat3& inertia_body, double dt) {
    const Mat3 inertia = R0 * inertia_body * R0.transpose();
    const auto evaluate = [&](const Vec3& u, ConservingSubstep& substep) -> Vec3 {
        substep.R0 = R0;
        substep.inertia = inertia;
        substep.momentum = momentum;
        substep.u = u;
        substep.rotation = 0.5 * dt * (w0 + u);
        substep.turn = exp_rotation(substep.rotation);
        return inertia * u - substep.turn.transpose() * momentum;
    };
    const auto jacobian = [&](const ConservingSubstep& substep) -> Mat3 {
        return conserving_jacobian(substep, dt, left_jacobian(substep.rotation));
    };
    const double scale = std::max(momentum.norm(), inertia_body.norm() * std::max(w0.norm(), guess.norm()));
    return newton_substep<ConservingSubstep>(guess, momentum, scale, evaluate, jacobian);
}

/// The whole step in a given number of substeps; empty if one of them did not converge.
std::vector<ConservingSubstep> solve_conserving_substeps(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt, int count) {
    std::vector<ConservingSubstep> substeps;
    substeps.reserve(static_cast<std::size_t>(count));
    const double dt_sub = dt / count;
    Mat3 R = R0;
    Vec3 w = angular_velocity;
    Vec3 momentum = R0 * inertia_body * R0.transpose() * angular_velocity;
    for (int k = 0; k < count; ++k) {
        momentum += dt_sub * torque;
        const Vec3 guess = initial_guess(R * inertia_body * R.transpose(), w, torque, dt_sub);
        substeps.push_back(solve_conserving_substep(R, w, guess, momentum, inertia_body, dt_sub));
        const ConservingSubstep& substep = substeps.back();
        if (!substep.converged) return {};
        R = substep.turn * R;
        w = substep.turn * substep.u;
    }
    return substeps;
}

}  // namespace

FreeRotation conserving_rotation(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt) {
    if (angular_velocity.isZero(0.0) && torque.isZero(0.0)) return {Vec3::Zero(), Vec3::Zero(), 1};
    const Vec3 guess = initial_guess(R0 * inertia_body * R0.transpose(), angular_velocity, torque, dt);
    for (int count = substeps_for(dt * std::max(angular_velocity.norm(), guess.norm())); count <= kMaxSubsteps;
         count *= 2) {
        const std::vector<ConservingSubstep> substeps =
            solve_conserving_substeps(R0, angular_velocity, torque, inertia_body, dt, count);
        if (substeps.empty()) continue;
        const ConservingSubstep& last = substeps.back();
        const Vec3 w = last.turn * last.u;
        if (count == 1) return {w, last.rotation, 1};
        return {w, log_rotation(last.turn * last.R0 * R0.transpose()), count};
    }
    return {angular_velocity, Vec3::Zero(), 0};
}

FreeRotationGradient conserving_rotation_backward(
    const Mat3& R0, const Vec3& angular_velocity, const Vec3& torque, const Mat3& inertia_body, double dt,
    const FreeRotation& result, const Vec3& grad_angular_velocity, const Vec3& grad_rotation, bool with_inertia) {
    FreeRotationGradient grad;
    if (result.substeps == 0) {  // held
        grad.angular_velocity = grad_angular_velocity;
        return grad;
    }
    const std::vector<ConservingSubstep> substeps =
        solve_conserving_substeps(R0, angular_velocity, torque, inertia_body, dt, result.substeps);
    assert(!substeps.empty());  // as in the forward
    const bool single = substeps.size() == 1;
    const double half = 0.5 * dt / static_cast<double>(substeps.size());

    Vec3 covector = Vec3::Zero();  // of the orientation at the end of the substep at hand
    if (!single) covector = log_rotation_backward(result.rotation, grad_rotation, grad.orientation);
    Vec3 grad_w = grad_angular_velocity;
    Vec3 grad_momentum = Vec3::Zero();  // of that at the start, and of what torque adds in the substep at hand
    for (std::size_t k = substeps.size(); k-- > 0;) {
        const ConservingSubstep& substep = substeps[k];
        const Mat3 jacobian = left_jacobian(substep.rotation);
        // w1 = Exp(rotation) u and R1 = Exp(rotation) R0
        const Vec3 w1 = substep.turn * substep.u;
        Vec3 grad_turn = jacobian.transpose() * (covector + w1.cross(grad_w));
        if (single) grad_turn += grad_rotation;
        const Vec3 grad_u = substep.turn.transpose() * grad_w + half * grad_turn;
        // I u - Exp(-rotation) momentum = 0
        const Vec3 multiplier =
            conserving_jacobian(substep, 2.0 * half, jacobian).transpose().partialPivLu().solve(grad_u);
        const Vec3 by_momentum = substep.turn * multiplier;
        grad_turn += jacobian.transpose() * by_momentum.cross(substep.momentum);
        grad_momentum += by_momentum;
        grad.torque += 2.0 * half * grad_momentum;
        if (with_inertia) grad.inertia_body -= inertia_body_gradient(substep.R0, substep.u, multiplier);
        covector =
            substep.turn.transpose() * covector - inertia_rotation_gradient(substep.inertia, substep.u, multiplier);
        grad_w = half * grad_turn;
    }
    const Mat3& inertia0 = substeps.front().inertia;
    grad.orientation += covector + inertia_rotation_gradient(inertia0, angular_velocity, grad_momentum);
    grad.angular_velocity = grad_w + inertia0 * grad_momentum;
    if (with_inertia) grad.inertia_body += inertia_body_gradient(R0, angular_velocity, grad_momentum);
    return grad;
}

}  // namespace diffsim
