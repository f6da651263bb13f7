#include "math/positive_part.hpp"

#if defined(__GNUC__) && !defined(__clang__)
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // GCC 12 takes an empty matrix for possible
#endif
#include <Eigen/Eigenvalues>

namespace diffsim {
namespace {

constexpr int kLargest = 18;

/// For several sizes at once, and without a heap: of each fixed size Eigen would unroll a solver of its own.
using AnySize = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kLargest, kLargest>;

template <class Matrix>
Matrix cut(const Matrix& symmetric) {
    const Eigen::SelfAdjointEigenSolver<Matrix> eigen(symmetric);
    return eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).asDiagonal() * eigen.eigenvectors().transpose();
}

}  // namespace

template <int N>
Eigen::Matrix<double, N, N> positive_part(const Eigen::Matrix<double, N, N>& symmetric) {
    if constexpr (N == 3)
        return cut(symmetric);
    else
        return cut<AnySize>(symmetric);
}

template Eigen::Matrix<double, 3, 3> positive_part(const Eigen::Matrix<double, 3, 3>&);
template Eigen::Matrix<double, 6, 6> positive_part(const Eigen::Matrix<double, 6, 6>&);
template Eigen::Matrix<double, 9, 9> positive_part(const Eigen::Matrix<double, 9, 9>&);
template Eigen::Matrix<double, 15, 15> positive_part(const Eigen::Matrix<double, 15, 15>&);
template Eigen::Matrix<double, 18, 18> positive_part(const Eigen::Matrix<double, 18, 18>&);

}  // namespace diffsim
