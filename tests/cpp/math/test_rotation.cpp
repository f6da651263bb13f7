#include "math/rotation.hpp"

#include <Eigen/LU>

#include "fixtures.hpp"

namespace test_rotation {

using namespace diffsim;
using fixtures::numeric_gradient;
using fixtures::numeric_jacobian;
using fixtures::random_direction;
using fixtures::random_vec3;

namespace {

// On both sides of where the series hand over to the closed forms, and up to nearly a full turn.
const double kAngles[] = {0.0, 1e-9, 1e-3, 0.2 - 1e-9, 0.2 + 1e-9, 1.0, 3.0, 3.1, 6.0};
constexpr double kRounding = 1e-14;        // a few operations on numbers of order 1
constexpr double kSeriesRounding = 1e-12;  // terms up to e^6 = 400 cancel in the reference
constexpr double kDifferences = 1e-9;      // eps / step, at step 1e-4; truncation is step⁴
constexpr double kStep = 1e-4;
constexpr int kAxes = 5;

/// Σ skew(theta)^k / (k + shift)!, as many terms as 6^k / k! needs: Exp for shift 0, its left Jacobian for shift 1.
Mat3 power_series(const Vec3& theta, int shift) {
    Mat3 sum = Mat3::Identity(), term = Mat3::Identity();
    for (int k = 1; k < 60; ++k) {
        term = term * skew(theta) / (k + shift);
        sum += term;
    }
    return sum;
}

template <typename Test>
void for_all_rotations(const Test& test) {
    check::Random random(1);
    for (const double angle : kAngles) {
        NOTE(angle);
        for (int k = 0; k < kAxes; ++k) test(Vec3(angle * random_direction(random)), random);
    }
}

}  // namespace

TEST(exp_agrees_with_its_series) {
    for_all_rotations([](const Vec3& theta, check::Random&) {
        const Mat3 R = exp_rotation(theta);
        CHECK_NEAR(R, power_series(theta, 0), kSeriesRounding);
        CHECK_NEAR(R * R.transpose(), Mat3::Identity(), kRounding);
        CHECK_NEAR(quaternion_to_matrix(exp_quaternion(theta)), R, kRounding);
    });
    const Mat3 quarter = exp_rotation(0.5 * EIGEN_PI * Vec3::UnitZ());
    CHECK_NEAR(quarter * Vec3::UnitX(), Vec3::UnitY(), kRounding);
}

TEST(left_jacobian_agrees_with_its_series_and_its_definition) {
    for_all_rotations([](const Vec3& theta, check::Random& random) {
        const Mat3 J = left_jacobian(theta);
        CHECK_NEAR(J, power_series(theta, 1), kSeriesRounding);
        // Exp(theta + t d) Exp(theta)ᵀ = 1 + t skew(J d) + O(t²)
        const Vec3 d = random_direction(random);
        const auto turn = [&](const VectorX& t) -> VectorX {
            return (exp_rotation(theta + t[0] * d) * exp_rotation(theta).transpose()).reshaped();
        };
        const VectorX numeric = numeric_jacobian(turn, VectorX::Zero(1), kStep);
        CHECK_NEAR(VectorX(skew(J * d).reshaped()), numeric, kDifferences);
    });
}

TEST(derivative_of_transposed_left_jacobian_agrees_with_differences) {
    for_all_rotations([](const Vec3& theta, check::Random& random) {
        const Vec3 tau = random_vec3(random);
        const Mat3 analytic = left_jacobian_transposed_derivative(theta, tau);
        const auto product = [&](const VectorX& at) -> VectorX { return left_jacobian(Vec3(at)).transpose() * tau; };
        CHECK(analytic.norm() > 0.1 * tau.norm());
        CHECK_NEAR(analytic, numeric_jacobian(product, theta, kStep), kDifferences);
    });
}

TEST(series_and_closed_forms_meet) {
    // What the closed forms lose at the switch: eps / 0.2⁴ in the derivative.
    constexpr double kLost = 1e-12;
    check::Random random(2);
    for (int k = 0; k < 20; ++k) {
        const Vec3 axis = random_direction(random), tau = random_vec3(random);
        const Vec3 below = (0.2 - 1e-14) * axis, above = (0.2 + 1e-14) * axis;
        CHECK_NEAR(exp_rotation(below), exp_rotation(above), 10.0 * kRounding);
        CHECK_NEAR(left_jacobian(below), left_jacobian(above), 10.0 * kRounding);
        CHECK_NEAR(
            left_jacobian_transposed_derivative(below, tau), left_jacobian_transposed_derivative(above, tau), kLost);
    }
}

TEST(log_inverts_exp) {
    for_all_rotations([](const Vec3& theta, check::Random&) {
        const double angle = theta.norm();
        const Vec3 log = log_rotation(exp_rotation(theta));
        const Vec3 shortest = angle <= EIGEN_PI ? theta : Vec3((1.0 - 2.0 * EIGEN_PI / angle) * theta);
        CHECK_NEAR(log, shortest, kRounding * std::max(log.norm(), 1e-9));
    });
    check::Random random(3);
    for (const double angle : {EIGEN_PI - 1e-9, EIGEN_PI, EIGEN_PI + 1e-9}) {  // either sign of the axis is right there
        const Mat3 R = exp_rotation(angle * random_direction(random));
        CHECK_NEAR(log_rotation(R).norm(), EIGEN_PI, 1e-8);
        CHECK_NEAR(exp_rotation(log_rotation(R)), R, 10.0 * kRounding);
    }
}

TEST(quaternion_product_is_composition) {
    check::Random random(4);
    for (int k = 0; k < 20; ++k) {
        const Vec4 a = exp_quaternion(3.0 * random_vec3(random)), b = exp_quaternion(3.0 * random_vec3(random));
        const Mat3 product = quaternion_to_matrix(a) * quaternion_to_matrix(b);
        CHECK_NEAR(quaternion_to_matrix(quaternion_multiply(a, b)), product, kRounding);
        CHECK_NEAR(quaternion_to_matrix(-a), quaternion_to_matrix(a), kRounding);
    }
}

TEST(quaternion_gradients_agree_with_differences) {
    check::Random random(5);
    for (int k = 0; k < 20; ++k) {
        const Vec4 q = exp_quaternion(3.0 * random_vec3(random));
        const Mat3 weights = random.matrix(3, 3);
        const auto loss = [&](const VectorX& at) { return weights.cwiseProduct(quaternion_to_matrix(Vec4(at))).sum(); };
        const auto turned = [&](const VectorX& phi) { return loss(quaternion_multiply(exp_quaternion(Vec3(phi)), q)); };
        const Vec3 covector = quaternion_gradient_to_covector(q, Vec4(numeric_gradient(loss, q, kStep)));
        CHECK(covector.norm() > 1e-2);
        CHECK_NEAR(covector, numeric_gradient(turned, Vec3::Zero(), kStep), kDifferences);

        const double scale = random.uniform(0.5, 2.0);  // the way back must not care how long q is
        const auto of_direction = [&](const VectorX& at) { return loss(VectorX(at.normalized())); };
        const Vec4 grad = covector_to_quaternion_gradient(scale * q, covector);
        CHECK_NEAR(grad, numeric_gradient(of_direction, scale * q, kStep), 10.0 * kDifferences);
        CHECK_NEAR(grad.dot(q), 0.0, kRounding * grad.norm());
        CHECK_NEAR(
            quaternion_gradient_to_covector(q, covector_to_quaternion_gradient(q, covector)), covector,
            kRounding * covector.norm());
    }
}

}  // namespace test_rotation
