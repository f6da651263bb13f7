#include "math/rotation.hpp"

#include <Eigen/Geometry>
#include <cmath>

namespace diffsim {
namespace {

/// Below this squared angle the Taylor series are used; with the terms kept they are exact to
/// rounding there, while the closed forms lose about eps / angle^4 in their derivatives.
constexpr double kSeriesAngleSq = 0.04;

/// The scalar functions of the angle t that all the maps above are made of.
struct AngleFunctions {
    double a;  ///< sin(t) / t
    double b;  ///< (1 - cos t) / t^2
    double c;  ///< (t - sin t) / t^3
};

AngleFunctions angle_functions(double angle_sq) {
    if (angle_sq < kSeriesAngleSq) {
        const double s = angle_sq;
        return {
            1.0 + s * (-1.0 / 6 + s * (1.0 / 120 + s * (-1.0 / 5040 + s * (1.0 / 362880 - s / 39916800)))),
            0.5 + s * (-1.0 / 24 + s * (1.0 / 720 + s * (-1.0 / 40320 + s * (1.0 / 3628800 - s / 479001600)))),
            1.0 / 6 + s * (-1.0 / 120 + s * (1.0 / 5040 + s * (-1.0 / 362880 + s / 39916800)))};
    }
    const double angle = std::sqrt(angle_sq);
    const double sine = std::sin(angle);
    return {sine / angle, (1.0 - std::cos(angle)) / angle_sq, (angle - sine) / (angle_sq * angle)};
}

}  // namespace

Mat3 exp_rotation(const Vec3& theta) {
    const AngleFunctions f = angle_functions(theta.squaredNorm());
    const Mat3 k = skew(theta);
    Mat3 result = f.a * k + f.b * (k * k);
    result.diagonal().array() += 1.0;
    return result;
}

Vec4 exp_quaternion(const Vec3& theta) {
    const double half_angle_sq = 0.25 * theta.squaredNorm();
    const AngleFunctions half = angle_functions(half_angle_sq);
    Vec4 q;
    q << std::cos(std::sqrt(half_angle_sq)), 0.5 * half.a * theta;
    return q / q.norm();
}

Vec3 log_rotation(const Mat3& rotation) {
    const Eigen::AngleAxisd angle_axis(Eigen::Quaterniond(rotation).normalized());
    return angle_axis.angle() * angle_axis.axis();
}

Mat3 left_jacobian(const Vec3& theta) {
    const AngleFunctions f = angle_functions(theta.squaredNorm());
    const Mat3 k = skew(theta);
    Mat3 result = f.b * k + f.c * (k * k);
    result.diagonal().array() += 1.0;
    return result;
}

Mat3 left_jacobian_transposed_derivative(const Vec3& theta, const Vec3& tau) {
    // J^T tau = tau - b theta x tau + c theta x (theta x tau), with b, c functions of |theta|.
    const double s = theta.squaredNorm();
    const AngleFunctions f = angle_functions(s);
    double db;  // (db/dangle) / angle
    double dc;  // (dc/dangle) / angle
    if (s < kSeriesAngleSq) {
        db = -1.0 / 12.0 *
             (1.0 - s / 15.0 * (1.0 - 3.0 * s / 112.0 * (1.0 - 2.0 * s / 135.0 * (1.0 - 5.0 * s / 528.0))));
        dc = -1.0 / 60.0 * (1.0 - s / 21.0 * (1.0 - s / 48.0 * (1.0 - 2.0 * s / 165.0 * (1.0 - 5.0 * s / 624.0))));
    } else {
        // a = sin/t, so db = (a - 2 b) / t^2 and dc = (b - 3 c) / t^2.
        db = (f.a - 2.0 * f.b) / s;
        dc = (f.b - 3.0 * f.c) / s;
    }
    const Vec3 once = theta.cross(tau);
    const Vec3 twice = theta.cross(once);
    const Mat3 tau_skew = skew(tau);
    return f.b * tau_skew - f.c * (skew(once) + skew(theta) * tau_skew) + (dc * twice - db * once) * theta.transpose();
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
