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
    Vec3 angular_velocity, rotation;
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

Substep substep_at(const Mat3& R0, const Vec3& angular_velocity, const Mat3& inertia_body, double dt) {
    Substep substep;
    substep.angular_velocity = angular_velocity;
    substep.rotation = dt * angular_velocity;
    substep.turn = exp_rotation(substep.rotation);
    substep.R1 = substep.turn * R0;
    substep.inertia_world = substep.R1 * inertia_body * substep.R1.transpose();
    return substep;
}

/// I(Exp(dt w) R0) w = momentum from the guess w.
Substep solve_substep(const Mat3& R0, const Vec3& guess, const Vec3& momentum, const Mat3& inertia_body, double dt) {
    const auto evaluate = [&](const Vec3& w, Substep& substep) -> Vec3 {
        substep = substep_at(R0, w, inertia_body, dt);
        return substep.inertia_world * w - momentum;
    };
    const auto jacobian = [&](const Substep& substep) -> Mat3 {
        return momentum_jacobian(substep, dt, left_jacobian(substep.rotation));
    };
    const double scale = std::max(momentum.norm(), inertia_body.norm() * guess.norm());
    return newton_substep<Substep>(guess, momentum, scale, evaluate, jacobian);
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
        single = substep_at(R0, result.angular_velocity, inertia_body, dt);
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
        covector = log_rotation_backward(result.rotation, grad_rotation, grad.orientation);
    }
    Vec3 grad_momentum = Vec3::Zero();
    for (std::size_t k = count; k-- > 0;) {
        const Substep& substep = substeps[k];
        const Vec3& w = substep.angular_velocity;
        const Mat3 jacobian = left_jacobian(substep.rotation);
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
