#pragma once

#include "math/types.hpp"

namespace diffsim {

/// Symmetric matrix with its negative eigenvalues set to zero: the nearest positive semidefinite one. For N = 3, 6, 9,
/// 15 and 18; instantiated out of line, since each takes the compiler long.
template <int N>
Eigen::Matrix<double, N, N> positive_part(const Eigen::Matrix<double, N, N>& symmetric);

/// Take this share of its negative part, 0 to 1, off a symmetric matrix.
template <int N>
void cut_negative_part(double share, Eigen::Matrix<double, N, N>& symmetric) {
    if (share == 0.0) return;
    const Eigen::Matrix<double, N, N> part = positive_part<N>(symmetric);
    if (share == 1.0)
        symmetric = part;
    else
        symmetric += share * (part - symmetric);
}

}  // namespace diffsim
