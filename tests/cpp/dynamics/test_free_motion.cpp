#include "dynamics/free_motion.hpp"

#include <algorithm>

#include "dynamics/conserving_rotation.hpp"
#include "fixtures.hpp"

namespace test_free_motion {

using namespace diffsim;
using fixtures::random_direction;
using fixtures::random_inertia;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kDt = 0.01;  // [s]

struct Scheme {
    const char* name;
    decltype(&free_rotation) forward;
    decltype(&free_rotation_backward) backward;
};
const Scheme kSchemes[] = {
    {"implicit Euler", free_rotation, free_rotation_backward},
    {"conserving", conserving_rotation, conserving_rotation_backward}};

/// Angular momentum at the end minus what it should be, relative to the largest inertia times the spin: that is what
/// one unit of rounding in the orientation is worth.
double momentum_error(
    const Mat3& R0, const Vec3& w0, const Vec3& torque, const Mat3& inertia, const FreeRotation& result) {
    const Mat3 R1 = exp_rotation(result.rotation) * R0;
    const Vec3 momentum0 = R0 * inertia * R0.transpose() * w0 + kDt * torque;
    const Vec3 momentum1 = R1 * inertia * R1.transpose() * result.angular_velocity;
    const double scale = inertia.norm() * std::max(w0.norm(), result.angular_velocity.norm());
    return (momentum1 - momentum0).norm() / scale;
}

Mat3 symmetric(const VectorX& six) {
    Mat3 m;
    m << six[0], six[3], six[4], six[3], six[1], six[5], six[4], six[5], six[2];
    return m;
}

/// Inputs around one point, as one vector of perturbations: turn of R0, w0, torque, the six entries of the inertia.
struct Problem {
    Mat3 R0, inertia;
    Vec3 w0, torque;
    Vec3 weight_w, weight_rotation;  // of the loss
    double size_w = 1.0;             // [rad/s], unit of w0 and of the torque's effect in the vector
    Scheme scheme = kSchemes[0];

    FreeRotation solve(const VectorX& x) const {
        return scheme.forward(
            exp_rotation(Vec3(x.head<3>())) * R0, w0 + size_w * x.segment<3>(3), torque + size_w * x.segment<3>(6),
            inertia + symmetric(x.tail<6>()), kDt);
    }
    double loss(const VectorX& x) const {
        const FreeRotation result = solve(x);
        return weight_w.dot(result.angular_velocity) / size_w + weight_rotation.dot(result.rotation);
    }
    VectorX gradient() const {
        const FreeRotation result = solve(VectorX::Zero(15));
        const FreeRotationGradient g =
            scheme.backward(R0, w0, torque, inertia, kDt, result, weight_w / size_w, weight_rotation, true);
        const Mat3& I = g.inertia_body;
        VectorX x(15);
        x << g.orientation, size_w * g.angular_velocity, size_w * g.torque, I(0, 0), I(1, 1), I(2, 2), 2.0 * I(0, 1),
            2.0 * I(0, 2), 2.0 * I(1, 2);
        return x;
    }
};

Problem random_problem(check::Random& random, double spin, double torque, double ratio) {
    Problem problem;
    problem.R0 = random_rotation(random);
    problem.inertia = random_inertia(random, ratio);
    problem.w0 = spin * random_direction(random);
    problem.torque = torque * random_direction(random);
    problem.weight_w = random_vec3(random);
    problem.weight_rotation = random_vec3(random);
    problem.size_w = std::max(spin, 1.0);
    return problem;
}

}  // namespace

TEST(angular_momentum_is_kept_to_rounding) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        constexpr double kPerSubstep = 64.0 * kEpsilon;  // a handful of 3x3 products each
        check::Random random(1);
        int cases_hit = 0;
        for (const double ratio : {1.0, 3.0, 100.0, 1000.0}) {
            for (const double spin : {0.0, 1e-6, 1.0, 30.0, 90.0, 300.0, 1e4}) {
                for (int k = 0; k < 6; ++k) {
                    NOTE(ratio);
                    NOTE(spin);
                    NOTE(k);
                    const Mat3 R0 = random_rotation(random), inertia = random_inertia(random, ratio);
                    const Vec3 w0 = spin * random_direction(random);
                    const FreeRotation result = scheme.forward(R0, w0, Vec3::Zero(), inertia, kDt);
                    CHECK(result.substeps >= 1);
                    if (spin == 0.0) {
                        CHECK(result.angular_velocity.isZero(0.0));
                        continue;
                    }
                    CHECK(result.rotation.norm() > 0.0);
                    CHECK(result.substeps < 20.0 + 10.0 * kDt * spin * ratio);
                    CHECK(momentum_error(R0, w0, Vec3::Zero(), inertia, result) <= kPerSubstep * result.substeps);
                    ++cases_hit;
                }
            }
        }
        CHECK(cases_hit >= 100);
    }
}

TEST(a_pencil_spins_about_its_axis) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        // The momentum is small beside the largest inertia times the spin: rounding in the latter must not look like
        // failure to converge.
        check::Random random(2);
        for (const double ratio : {10.0, 100.0, 1000.0}) {
            for (const double spin : {1.0, 50.0, 500.0}) {
                NOTE(ratio);
                NOTE(spin);
                const Mat3 R0 = random_rotation(random);
                const Mat3 inertia = Vec3(1.0, ratio, ratio).asDiagonal();
                const Vec3 w0 = spin * R0.col(0);
                const FreeRotation result = scheme.forward(R0, w0, Vec3::Zero(), inertia, kDt);
                CHECK(result.substeps >= 1);
                CHECK(result.substeps <= 2.0 * kDt * spin + 2.0);
                CHECK_NEAR(result.angular_velocity, w0, 1e-12 * spin * result.substeps);
            }
        }
    }
}

TEST(torque_adds_to_the_momentum) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        check::Random random(3);
        for (const double torque : {1e-3, 1.0, 1e3, 1e5}) {
            NOTE(torque);
            const Mat3 R0 = random_rotation(random), inertia = random_inertia(random, 5.0);
            const Vec3 w0 = random_vec3(random, 2.0), tau = torque * random_direction(random);
            const FreeRotation result = scheme.forward(R0, w0, tau, inertia, kDt);
            CHECK(result.substeps >= 1);
            CHECK(momentum_error(R0, w0, tau, inertia, result) <= 64.0 * kEpsilon * result.substeps);
        }
    }
}

TEST(a_sphere_turns_as_it_spins) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        const Mat3 inertia = 0.4 * Mat3::Identity();
        const Vec3 w0(1.0, -2.0, 3.0);
        const FreeRotation slow = scheme.forward(exp_rotation(Vec3(0.3, 0.2, 0.1)), w0, Vec3::Zero(), inertia, kDt);
        CHECK_NEAR(slow.angular_velocity, w0, 1e-14);
        CHECK_NEAR(slow.rotation, kDt * w0, 1e-15);
        CHECK(slow.substeps == 1);
        // 100 turns and an eighth: in substeps, and back to less than half a turn.
        const double spin = 2.0 * EIGEN_PI * 100.125 / kDt;
        const FreeRotation fast = scheme.forward(Mat3::Identity(), spin * Vec3::UnitZ(), Vec3::Zero(), inertia, kDt);
        CHECK(fast.substeps > 1);
        CHECK_NEAR(fast.rotation, 0.25 * EIGEN_PI * Vec3::UnitZ(), 1e-11);
        CHECK_NEAR(fast.angular_velocity, spin * Vec3::UnitZ(), 1e-11 * spin);
    }
}

TEST(backward_agrees_with_differences) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        constexpr double kTolerance = 1e-7;  // of the gradient's norm; the step is solved to eps, differenced over 1e-4
        check::Random random(4);
        int single = 0, many = 0;
        for (const double ratio : {1.5, 20.0}) {
            for (const double spin : {0.0, 1.0, 60.0, 220.0, 1234.0}) {
                for (const double torque : {0.0, 3.0}) {
                    NOTE(ratio);
                    NOTE(spin);
                    NOTE(torque);
                    Problem problem = random_problem(random, spin, torque, ratio);
                    problem.scheme = scheme;
                    const FreeRotation result = problem.solve(VectorX::Zero(15));
                    if (result.rotation.norm() > 3.0) continue;  // next to the jump of the logarithm at half a turn
                    (result.substeps == 1 ? single : many) += 1;
                    const VectorX analytic = problem.gradient();
                    const auto loss = [&](const VectorX& x) { return problem.loss(x); };
                    const VectorX numeric =
                        fixtures::numeric_gradient(loss, VectorX::Zero(15), spin > 100.0 ? 1e-5 : 1e-4);
                    CHECK(analytic.segment<3>(3).norm() > 1e-3);
                    CHECK_NEAR(analytic, numeric, kTolerance * (1.0 + result.substeps) * analytic.norm());
                }
            }
        }
        CHECK(single >= 8);
        CHECK(many >= 5);
    }
}

TEST(every_input_of_the_backward_has_its_own_gradient) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        constexpr double kTolerance = 1e-7;
        check::Random random(5);
        for (const double spin : {40.0, 250.0}) {
            NOTE(spin);
            Problem problem = random_problem(random, spin, 5.0, 4.0);
            problem.scheme = scheme;
            const VectorX analytic = problem.gradient();
            const auto loss = [&](const VectorX& x) { return problem.loss(x); };
            const VectorX numeric = fixtures::numeric_gradient(loss, VectorX::Zero(15), 1e-5);
            const std::pair<int, int> parts[] = {{0, 3}, {3, 3}, {6, 3}, {9, 6}};
            for (const auto& [begin, size] : parts) {
                NOTE(begin);
                const VectorX part = analytic.segment(begin, size);
                CHECK(part.norm() > 0.0);
                CHECK_NEAR(part, VectorX(numeric.segment(begin, size)), 1e2 * kTolerance * part.norm());
            }
        }
    }
}

TEST(parts_of_the_inertia_term) {
    check::Random random(6);
    const Mat3 R = random_rotation(random), inertia = random_inertia(random, 4.0);
    const Vec3 w = random_vec3(random), covector = random_vec3(random);
    const auto turned = [&](const VectorX& phi) {
        const Mat3 Rp = exp_rotation(Vec3(phi)) * R;
        return covector.dot(Rp * inertia * Rp.transpose() * w);
    };
    const Vec3 by_turn = inertia_rotation_gradient(R * inertia * R.transpose(), w, covector);
    CHECK(by_turn.norm() > 1e-2);
    CHECK_NEAR(by_turn, fixtures::numeric_gradient(turned, Vec3::Zero(), 1e-4), 1e-10);
    const Mat3 change = symmetric(random.vector(6));
    const double by_inertia = inertia_body_gradient(R, w, covector).cwiseProduct(change).sum();
    CHECK_NEAR(by_inertia, covector.dot(R * change * R.transpose() * w), 1e-14);
}

TEST(a_spin_beyond_all_substeps_is_held_and_says_so) {
    for (const Scheme& scheme : kSchemes) {
        NOTE(scheme.name);
        const Mat3 inertia = Vec3(1.0, 2.0, 2.5).asDiagonal();
        for (const double spin : {1e9, 1e100, 1e200, 1e300}) {
            NOTE(spin);
            const Vec3 w0 = spin * Vec3(0.3, 1.0, 0.2);
            const FreeRotation result = scheme.forward(Mat3::Identity(), w0, Vec3::Zero(), inertia, 0.01);
            CHECK(result.substeps == 0);
            CHECK(result.angular_velocity == w0);
            CHECK(result.rotation.isZero(0.0));
            const FreeRotationGradient grad = scheme.backward(
                Mat3::Identity(), w0, Vec3::Zero(), inertia, 0.01, result, Vec3(1, 2, 3), Vec3(4, 5, 6), true);
            CHECK(grad.angular_velocity == Vec3(1, 2, 3));
            CHECK(grad.torque.isZero(0.0));
            CHECK(grad.orientation.isZero(0.0));
        }
    }
}

TEST(the_conserving_scheme_keeps_energy) {
    check::Random random(7);
    for (const double ratio : {1.0, 3.0, 100.0}) {
        for (const double spin : {1.0, 90.0, 300.0}) {
            NOTE(ratio);
            NOTE(spin);
            const Mat3 R0 = random_rotation(random), inertia = random_inertia(random, ratio);
            const Vec3 w0 = spin * random_direction(random);
            const FreeRotation result = conserving_rotation(R0, w0, Vec3::Zero(), inertia, kDt);
            const Vec3 before = R0.transpose() * w0;
            const Vec3 after = (exp_rotation(result.rotation) * R0).transpose() * result.angular_velocity;
            const double energy = before.dot(inertia * before), scale = inertia.norm() * w0.squaredNorm();
            CHECK_NEAR(after.dot(inertia * after), energy, 64.0 * kEpsilon * result.substeps * scale);
        }
    }
}

TEST(the_conserving_scheme_goes_back_the_way_it_came) {
    check::Random random(8);
    for (const double spin : {1.0, 60.0}) {
        NOTE(spin);
        const Mat3 R0 = random_rotation(random), inertia = random_inertia(random, 5.0);
        const Vec3 w0 = spin * random_direction(random), torque = random_vec3(random, 2.0);
        const FreeRotation there = conserving_rotation(R0, w0, torque, inertia, kDt);
        const Mat3 R1 = exp_rotation(there.rotation) * R0;
        const FreeRotation back = conserving_rotation(R1, -there.angular_velocity, torque, inertia, kDt);
        CHECK(there.rotation.norm() > 1e-3);
        CHECK_NEAR(back.rotation, -there.rotation, 1e-13);
        CHECK_NEAR(back.angular_velocity, -w0, 1e-12 * spin);
    }
}

}  // namespace test_free_motion
