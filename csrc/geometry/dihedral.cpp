#include "geometry/dihedral.hpp"

#include <Eigen/Geometry>
#include <cmath>

/// Notation of a side, with frame (t along the edge, N normal, m inward), height h, foot s and edge length l:
/// the gradient is w ⊗ u with u = -N / h and the weights w of p0, p1 and the corner, -(1 - s), -s, 1. For a
/// displacement dx of the points let δ = Σ w dx, which is how the corner moves off its foot, and de how the edge does:
///   ds = (t·δ + h m·de / l) / l        du = (m N·δ + N m·δ) / h² + t N·de / (h l).
/// The Hessian is what these make of d(w ⊗ u), summed over both sides.
namespace diffsim {
namespace {

/// A doubled area whose square is below this has no direction left, and the inverse heights would overflow [m⁴].
constexpr double kDegenerateAreaSq = 1e-200;

constexpr double kPi = EIGEN_PI;  // which is a long double

}  // namespace

DihedralFrame dihedral_frame(const Mat34& points) {
    DihedralFrame frame;
    const Vec3 edge = points.col(1) - points.col(0);
    const Vec3 arm_a = points.col(2) - points.col(0), arm_b = points.col(3) - points.col(0);
    const Vec3 normal_a = edge.cross(arm_a), normal_b = arm_b.cross(edge);
    const double area_a_sq = normal_a.squaredNorm(), area_b_sq = normal_b.squaredNorm();
    const double length_sq = edge.squaredNorm();
    if (!(area_a_sq > kDegenerateAreaSq && area_b_sq > kDegenerateAreaSq && length_sq > kDegenerateAreaSq))
        return frame;

    const double length = std::sqrt(length_sq);
    frame.degenerate = false;
    frame.inv_length = 1.0 / length;
    frame.along = edge * frame.inv_length;
    // (n_a x n_b)·t = -l n_a·(b - p0), which vanishes to rounding where flat.
    frame.angle = std::atan2(-length * normal_a.dot(arm_b), normal_a.dot(normal_b));

    const double inv_area_a = 1.0 / std::sqrt(area_a_sq), inv_area_b = 1.0 / std::sqrt(area_b_sq);
    const double inv_length_sq = frame.inv_length * frame.inv_length;
    DihedralFrame::Side& a = frame.side[0];
    a.normal = normal_a * inv_area_a;
    a.inward = a.normal.cross(frame.along);
    a.inv_height = length * inv_area_a;
    a.foot = arm_a.dot(edge) * inv_length_sq;
    DihedralFrame::Side& b = frame.side[1];
    b.normal = normal_b * inv_area_b;
    b.inward = frame.along.cross(b.normal);
    b.inv_height = length * inv_area_b;
    b.foot = arm_b.dot(edge) * inv_length_sq;
    return frame;
}

Mat34 dihedral_gradient(const DihedralFrame& frame) {
    if (frame.degenerate) return Mat34::Zero();
    const auto& [a, b] = frame.side;
    const Vec3 u_a = -a.inv_height * a.normal, u_b = -b.inv_height * b.normal;
    Mat34 gradient;
    gradient.col(0) = (a.foot - 1.0) * u_a + (b.foot - 1.0) * u_b;
    gradient.col(1) = -a.foot * u_a - b.foot * u_b;
    gradient.col(2) = u_a;
    gradient.col(3) = u_b;
    return gradient;
}

Mat12 dihedral_hessian(const DihedralFrame& frame) {
    Mat12 hessian = Mat12::Zero();
    if (frame.degenerate) return hessian;
    Mat3 h00 = Mat3::Zero(), h10 = Mat3::Zero(), h11 = Mat3::Zero(), turn = Mat3::Zero();
    for (int k = 0; k < 2; ++k) {
        const DihedralFrame::Side& side = frame.side[k];
        const double w0 = side.foot - 1.0, w1 = -side.foot;
        const Mat3 nm = side.normal * side.inward.transpose();
        const Mat3 bend = (side.inv_height * side.inv_height) * (nm + nm.transpose());
        const Mat3 slide = (side.inv_height * frame.inv_length * frame.along) * side.normal.transpose();
        const Mat3 corner0 = w0 * bend - slide, corner1 = w1 * bend + slide;
        const int row = 6 + 3 * k;
        hessian.block<3, 3>(row, row) = bend;
        hessian.block<3, 3>(row, 0) = corner0;
        hessian.block<3, 3>(row, 3) = corner1;
        hessian.block<3, 3>(0, row) = corner0.transpose();
        hessian.block<3, 3>(3, row) = corner1.transpose();
        h00 += w0 * (corner0 - slide.transpose());
        h10 += w1 * corner0 + w0 * slide.transpose();
        h11 += w1 * (corner1 + slide.transpose());
        turn += nm;
    }
    // Symmetric as a sum over both sides, up to rounding.
    turn = (0.5 * frame.inv_length * frame.inv_length) * (turn + turn.transpose()).eval();
    hessian.block<3, 3>(0, 0) = h00 + turn;
    hessian.block<3, 3>(3, 0) = h10 - turn;
    hessian.block<3, 3>(0, 3) = hessian.block<3, 3>(3, 0).transpose();
    hessian.block<3, 3>(3, 3) = h11 + turn;
    return hessian;
}

Mat34 dihedral_hessian_product(const DihedralFrame& frame, const Mat34& displacement) {
    if (frame.degenerate) return Mat34::Zero();
    const Vec3 edge_change = displacement.col(1) - displacement.col(0);
    Mat34 product = Mat34::Zero();
    for (int k = 0; k < 2; ++k) {
        const DihedralFrame::Side& side = frame.side[k];
        const Vec3 change =
            displacement.col(2 + k) - (1.0 - side.foot) * displacement.col(0) - side.foot * displacement.col(1);
        const double inv_height = side.inv_height;
        // du of the note above, and u ds.
        const Vec3 du = (inv_height * inv_height) *
                            (side.inward * side.normal.dot(change) + side.normal * side.inward.dot(change)) +
                        (inv_height * frame.inv_length * side.normal.dot(edge_change)) * frame.along;
        const Vec3 u_ds = (-frame.inv_length *
                           (inv_height * frame.along.dot(change) + frame.inv_length * side.inward.dot(edge_change))) *
                          side.normal;
        product.col(0) += (side.foot - 1.0) * du + u_ds;
        product.col(1) += -side.foot * du - u_ds;
        product.col(2 + k) = du;
    }
    return product;
}

double wrap_angle(double angle) {
    if (angle > kPi) return angle - 2.0 * kPi;
    if (angle <= -kPi) return angle + 2.0 * kPi;
    return angle;
}

}  // namespace diffsim
