#pragma once

#include <array>
#include <type_traits>

#include "math/types.hpp"

namespace diffsim {

/// Call body(k) for k from `begin` to `end`, each a constant, so that everything stays in registers.
template <int begin, int end, class Body>
void unrolled(const Body& body) {
    if constexpr (begin < end) {
        body(std::integral_constant<int, begin>());
        unrolled<begin + 1, end>(body);
    }
}

/// Factors A = L D Lᵀ of a small positive definite matrix, of a size known to the compiler. Without roots, which
/// would take as long as all else.
template <int N>
class SmallCholesky {
public:
    using Matrix = Eigen::Matrix<double, N, N>;
    using Vector = Eigen::Matrix<double, N, 1>;

    /// Uses the lower half of A. False if it is not positive definite.
    bool factorize(const Matrix& A) {
        unrolled<0, N>([&](auto j) { unrolled<j, N>([&](auto i) { m_L[i][j] = A.data()[N * j + i]; }); });
        bool positive = true;
        unrolled<0, N>([&](auto k) {
            const double pivot = m_L[k][k];
            positive = positive && pivot > 0.0;
            m_inverse[k] = 1.0 / pivot;
            unrolled<k + 1, N>([&](auto j) {
                const double l = m_L[j][k] * m_inverse[k];
                unrolled<j, N>([&](auto i) { m_L[i][j] -= m_L[i][k] * l; });
            });
            unrolled<k + 1, N>([&](auto i) { m_L[i][k] *= m_inverse[k]; });
        });
        return positive;
    }

    /// Overwrite b by A⁻¹ b.
    void solve_in_place(Vector& b) const {
        double* x = b.data();
        unrolled<0, N>([&](auto k) { unrolled<k + 1, N>([&](auto i) { x[i] -= m_L[i][k] * x[k]; }); });
        unrolled<0, N>([&](auto k) { x[k] *= m_inverse[k]; });
        unrolled<0, N>([&](auto k) {
            constexpr int row = N - 1 - k;
            unrolled<row + 1, N>([&](auto i) { x[row] -= m_L[i][row] * x[i]; });
        });
    }

private:
    std::array<std::array<double, N>, N> m_L;  // below the diagonal, which is one
    std::array<double, N> m_inverse;           // of D
};

}  // namespace diffsim
