#include "math/rotation.hpp"

#include <Eigen/Geometry>
#include <cmath>

namespace diffsim {
namespace {

/// Below this squared angle the Taylor series are used; with the terms kept they are exact to
/// rounding there, while the closed forms lose about eps / angle^4 in their derivatives.
constexpr double kSeriesAngleSq = 0.04;

// The scalar functions of the angle t that all the maps above are made of, given t².

/// sin(t) / t
double sine_function(double s) {
    if (s < kSeriesAngleSq)
        return 1.0 + s * (-1.0 / 6 + s * (1.0 / 120 + s * (-1.0 / 5040 + s * (1.0 / 362880 - s / 39916800))));
    const double angle = std::sqrt(s);
    return std::sin(angle) / angle;
}

/// (1 - cos t) / t^2
double cosine_function(double s) {
    if (s < kSeriesAngleSq)
        return 0.5 + s * (-1.0 / 24 + s * (1.0 / 720 + s * (-1.0 / 40320 + s * (1.0 / 3628800 - s / 479001600))));
    return (1.0 - std::cos(std::sqrt(s))) / s;
}

/// (t - sin t) / t^3
double cubic_function(double s) {
    if (s < kSeriesAngleSq) return 1.0 / 6 + s * (-1.0 / 120 + s * (1.0 / 5040 + s * (-1.0 / 362880 + s / 39916800)));
    const double angle = std::sqrt(s);
    return (angle - std::sin(angle)) / (s * angle);
}

/// I + first [theta]x + second [theta]x²
Mat3 combine(const Vec3& theta, double first, double second) {
    Mat3 result = (second * theta) * theta.transpose() + first * skew(theta);
    result.diagonal().array() += 1.0 - second * theta.squaredNorm();
    return result;
}

}  // namespace

Mat3 exp_rotation(const Vec3& theta) {
    const double s = theta.squaredNorm();
    return combine(theta, sine_function(s), cosine_function(s));
}

Vec4 exp_quaternion(const Vec3& theta) {
    const double half_angle_sq = 0.25 * theta.squaredNorm();
    Vec4 q;
    q << std::cos(std::sqrt(half_angle_sq)), 0.5 * sine_function(half_angle_sq) * theta;
    return q / q.norm();
}

Vec3 log_rotation(const Mat3& rotation) {
    const Eigen::AngleAxisd angle_axis(Eigen::Quaterniond(rotation).normalized());
    return angle_axis.angle() * angle_axis.axis();
}

Mat3 left_jacobian(const Vec3& theta) {
    const double s = theta.squaredNorm();
    return combine(theta, cosine_function(s), cubic_function(s));
}

Mat3 left_jacobian_transposed_derivative(const Vec3& theta, const Vec3& tau) {
    // J^T tau = tau - b theta x tau + c theta x (theta x tau), with b, c functions of |theta|.
    const double s = theta.squaredNorm();
    const double b = cosine_function(s), c = cubic_function(s);
    double db;  // (db/dangle) / angle
    double dc;  // (dc/dangle) / angle
    if (s < kSeriesAngleSq) {
        db = -1.0 / 12.0 *
             (1.0 - s / 15.0 * (1.0 - 3.0 * s / 112.0 * (1.0 - 2.0 * s / 135.0 * (1.0 - 5.0 * s / 528.0))));
        dc = -1.0 / 60.0 * (1.0 - s / 21.0 * (1.0 - s / 48.0 * (1.0 - 2.0 * s / 165.0 * (1.0 - 5.0 * s / 624.0))));
    } else {
        // With a = sin/t: db = (a - 2 b) / t^2 and dc = (b - 3 c) / t^2.
        db = (sine_function(s) - 2.0 * b) / s;
        dc = (b - 3.0 * c) / s;
    }
    const Vec3 once = theta.cross(tau);
    const Vec3 twice = theta.cross(once);
    const Mat3 tau_skew = skew(tau);
    return b * tau_skew - c * (skew(once) + skew(theta) * tau_skew) + (dc * twice - db * once) * theta.transpose();
}

Mat3 quaternion_to_matrix(const Vec4& q) {
    const double w = q[0], x = q[1], y = q[2], z = q[3];
    Mat3 m;
    m << 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),  //
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),   //
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y);
    return m;
}

Vec4 quaternion_multiply(const Vec4& a, const Vec4& b) {
    const Vec3 av = a.tail<3>(), bv = b.tail<3>();
    Vec4 result;
    result << a[0] * b[0] - av.dot(bv), a[0] * bv + b[0] * av + av.cross(bv);
    return result;
}

Vec3 quaternion_gradient_to_covector(const Vec4& q, const Vec4& grad_q) {
    const Vec3 qv = q.tail<3>(), gv = grad_q.tail<3>();
    // dq = 1/2 (-phi.qv, w phi + phi x qv)
    return 0.5 * (-grad_q[0] * qv + q[0] * gv + qv.cross(gv));
}

Vec4 covector_to_quaternion_gradient(const Vec4& q, const Vec3& covector) {
    const double norm_sq = q.squaredNorm();
    const Vec3 qv = q.tail<3>();
    Vec4 grad;
    grad << -covector.dot(qv), q[0] * covector + covector.cross(qv);
    return 2.0 / norm_sq * grad;
}

}  // namespace diffsim
