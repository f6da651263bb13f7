#pragma once

#include <memory>
#include <utility>
#include <vector>

#include "math/types.hpp"

namespace diffsim {

/// A symmetric positive definite matrix of 6x6 blocks on the graph of a zone's bodies, and its factorization.
///
/// One body takes a 6x6 Cholesky factor, a few a dense one, many a sparse one with a fill-reducing order. The order
/// of all sums is fixed by the pattern.
class BlockSystem {
public:
    BlockSystem();
    ~BlockSystem();
    BlockSystem(BlockSystem&&) noexcept;
    BlockSystem& operator=(BlockSystem&&) noexcept;

    /// Set the pattern: the number of bodies and the pairs (i < j, sorted, unique) with a block of their own.
    void set_pattern(int body_count, std::vector<std::pair<int, int>> pairs);

    int body_count() const { return m_body_count; }
    const std::vector<std::pair<int, int>>& pairs() const { return m_pairs; }

    void set_zero();
    Mat6& diagonal(int body) { return m_diagonal[body]; }
    const Mat6& diagonal(int body) const { return m_diagonal[body]; }
    /// Block (i, j) of pair number `pair`.
    Mat6& off_diagonal(int pair) { return m_off_diagonal[pair]; }
    const Mat6& off_diagonal(int pair) const { return m_off_diagonal[pair]; }

    /// False if the matrix is not positive definite.
    bool factorize();
    /// Overwrite the right-hand side by the solution. Needs a successful factorize().
    void solve_in_place(std::vector<Vec6>& rhs) const;
    /// out = matrix * in.
    void multiply(const std::vector<Vec6>& in, std::vector<Vec6>& out) const;

private:
    struct SparseFactor;

    int m_body_count = 0;
    std::vector<std::pair<int, int>> m_pairs;
    std::vector<Mat6> m_diagonal, m_off_diagonal;
    Mat6 m_single;    // Cholesky factor of one body
    MatrixX m_dense;  // Cholesky factor of a few
    std::unique_ptr<SparseFactor> m_sparse;
    bool m_pattern_changed = true;
};

}  // namespace diffsim
