#pragma once

#include "math/types.hpp"

namespace diffsim {

/// Symmetric matrix with its negative eigenvalues set to zero: the nearest positive semidefinite one. For N = 3, 6, 9,
/// 12, 15 and 18; instantiated out of line, since each takes the compiler long.
template <int N>
Eigen::Matrix<double, N, N> positive_part(const Eigen::Matrix<double, N, N>& symmetric);

}  // namespace diffsim
