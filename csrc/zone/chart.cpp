#include "zone/chart.hpp"

#include "math/positive_part.hpp"
#include "math/rotation.hpp"

namespace diffsim {

Mat6 chart_jacobian(const Vec6& y) {
    Mat6 jacobian = Mat6::Identity();
    jacobian.topLeftCorner<3, 3>() = left_jacobian(y.head<3>());
    return jacobian;
}

Mat3 chart_curvature(const Vec6& y, const Vec3& torque) {
    // The gradient is Jᵀ torque; along a turn phi = J dtheta the torque changes by (H - ½ [torque]x) phi, H symmetric.
    const Vec3 theta = y.head<3>();
    const Mat3 J = left_jacobian(theta);
    const Mat3 full = left_jacobian_transposed_derivative(theta, torque) - 0.5 * J.transpose() * skew(torque) * J;
    return 0.5 * (full + full.transpose());
}

namespace {

/// The diagonal block and the gradient of a body. One that has not turned and carries no
/// torque needs no change of chart.
void turn_body(
    const Vec6& y, Curvature curvature, CutShare cut, const Mat3& J, const Vec3& torque, Vec6& gradient, Mat6* block) {
    if (y.head<3>().isZero(0.0)) return;
    gradient.head<3>() = J.transpose() * torque;
    if (block == nullptr) return;
    block->topRows<3>() = J.transpose() * block->topRows<3>().eval();
    block->leftCols<3>() = block->leftCols<3>().eval() * J;
    if (curvature == Curvature::dropped || torque.isZero(0.0)) return;
    Mat3 extra = chart_curvature(y, torque);
    cut_negative_part<3>(cut, extra);
    block->topLeftCorner<3, 3>() += extra;
}

}  // namespace

void to_coordinates(
    const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
    BlockSystem* system) {
    const std::size_t count = static_cast<std::size_t>(zone.dynamic_count);
    std::vector<Mat3>& jacobian = derivatives.jacobian;
    derivatives.torque.resize(count);
    jacobian.resize(count);
    for (std::size_t i = 0; i < count; ++i) {
        const Vec6& y = point.y.bodies[i];
        Vec6& gradient = derivatives.gradient.bodies[i];
        derivatives.torque[i] = gradient.head<3>();
        jacobian[i].setIdentity();
        if (!y.head<3>().isZero(0.0)) jacobian[i] = left_jacobian(y.head<3>());
        Mat6* block = system != nullptr ? &system->diagonal(static_cast<int>(i)) : nullptr;
        turn_body(y, curvature, cut, jacobian[i], derivatives.torque[i], gradient, block);
    }
    if (system == nullptr) return;
    const BlockPattern& pattern = system->pattern();
    for (int k = 0; k < static_cast<int>(pattern.body_pairs.size()); ++k) {
        const auto [i, j] = pattern.body_pairs[k];
        Mat6& block = system->off_diagonal(k);
        block.topRows<3>() = jacobian[i].transpose() * block.topRows<3>().eval();
        block.leftCols<3>() = block.leftCols<3>().eval() * jacobian[j];
    }
    for (int k = 0; k < static_cast<int>(pattern.mixed_pairs.size()); ++k) {
        Mat63& block = system->mixed_pair(k);
        block.topRows<3>() = jacobian[pattern.mixed_pairs[k].first].transpose() * block.topRows<3>().eval();
    }
}

}  // namespace diffsim
