#pragma once

#include "math/types.hpp"

namespace diffsim {

/// A sum of symmetric matrices, kept as one half of it: meant is half + halfᵀ. A square fills one triangle only, and a
/// product of two vectors that is meant with its transpose is added once.
template <int N>
class HalfSymmetric {
public:
    HalfSymmetric() { set_zero(); }
    void set_zero() { m_half.setZero(); }

    /// Add factor * row rowᵀ.
    void add_square(double factor, const Vector<N>& row) {
        const Padded r = padded(row);
        add_columns_of_square<0>(r, factor * r);
    }

    /// Add column * rowᵀ and its transpose, for a row that is zero but for M numbers from `First` on.
    template <int First, int M>
    void add_outer(const Vector<N>& column, const Vector<M>& row) {
        const Padded c = padded(column);
        for (int j = 0; j < M; ++j) m_half.col(First + j) += row[j] * c;
    }

    /// A block of the half, to be added to.
    template <int Rows, int Columns>
    auto block(int row, int column) {
        return m_half.template block<Rows, Columns>(row, column);
    }

    Square<N> whole() const {
        const auto half = m_half.template topRows<N>();
        return half + half.transpose();
    }

private:
    // Columns of even length are made of whole registers of two numbers.
    static constexpr int kPadded = N + N % 2;
    using Padded = Vector<kPadded>;

    static Padded padded(const Vector<N>& v) {
        Padded result;
        if constexpr (N % 2 == 0)
            result = v;
        else
            result << v, 0.0;
        return result;
    }

    /// On the diagonal in blocks of two by two, half of each.
    template <int J>
    void add_columns_of_square(const Padded& row, const Padded& scaled) {
        constexpr int kFirst = J - J % 2, kBelow = kPadded - kFirst - 2;
        m_half.col(J).template segment<2>(kFirst) += (0.5 * scaled[J]) * row.template segment<2>(kFirst);
        if constexpr (kBelow > 0) m_half.col(J).template tail<kBelow>() += scaled[J] * row.template tail<kBelow>();
        if constexpr (J + 1 < N) add_columns_of_square<J + 1>(row, scaled);
    }

    Eigen::Matrix<double, kPadded, N> m_half;
};

}  // namespace diffsim
