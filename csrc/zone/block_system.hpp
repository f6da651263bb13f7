#pragma once

#include <array>
#include <memory>
#include <utility>
#include <vector>

#include "math/small_cholesky.hpp"
#include "math/sparse_block_cholesky.hpp"
#include "zone/coordinates.hpp"

/// Linear systems on a zone's bodies and nodes.
namespace diffsim {

using Mat63 = Eigen::Matrix<double, 6, 3>;
using IndexPairs = std::vector<std::pair<int, int>>;

/// Which blocks of a BlockSystem may be non-zero beside the diagonal. All lists sorted and unique.
struct BlockPattern {
    int body_count = 0, node_count = 0;
    IndexPairs body_pairs;   ///< i < j
    IndexPairs mixed_pairs;  ///< (body, node)
    IndexPairs node_pairs;   ///< i < j

    bool operator==(const BlockPattern& other) const {
        return body_count == other.body_count && node_count == other.node_count && body_pairs == other.body_pairs &&
               mixed_pairs == other.mixed_pairs && node_pairs == other.node_pairs;
    }
};

/// A symmetric positive definite matrix on the graph of a zone's bodies (6 rows each) and cloth nodes (3 rows
/// each), and its factorization.
///
/// One body takes a 6x6 Cholesky factor, a few a dense one, many, or nodes, a sparse one with a fill-reducing order.
/// The order of all sums is fixed by the pattern.
class BlockSystem {
public:
    BlockSystem();
    ~BlockSystem();
    BlockSystem(BlockSystem&&) noexcept;
    BlockSystem& operator=(BlockSystem&&) noexcept;

    void set_pattern(BlockPattern pattern);
    const BlockPattern& pattern() const { return m_pattern; }

    void set_zero();
    /// Take over the blocks of another system with the same pattern.
    void copy_values(const BlockSystem& other);
    Mat6& diagonal(int body) { return m_diagonal[body]; }
    const Mat6& diagonal(int body) const { return m_diagonal[body]; }
    /// Block (i, j) of body pair number `pair`.
    Mat6& off_diagonal(int pair) { return m_off_diagonal[pair]; }
    const Mat6& off_diagonal(int pair) const { return m_off_diagonal[pair]; }
    Mat3& node_diagonal(int node) { return m_node_diagonal[node]; }
    const Mat3& node_diagonal(int node) const { return m_node_diagonal[node]; }
    /// Block (i, j) of node pair number `pair`.
    Mat3& node_pair(int pair) { return m_node_pairs[pair]; }
    const Mat3& node_pair(int pair) const { return m_node_pairs[pair]; }
    /// Block (body, node) of mixed pair number `pair`.
    Mat63& mixed_pair(int pair) { return m_mixed_pairs[pair]; }
    const Mat63& mixed_pair(int pair) const { return m_mixed_pairs[pair]; }

    /// Number of the pair in its list, or -1.
    int find_node_pair(int i, int j) const;
    int find_mixed_pair(int body, int node) const;

    /// False if the matrix is not positive definite.
    bool factorize();
    /// Overwrite the right-hand side by the solution. Needs a successful factorize().
    void solve_in_place(Coordinates& rhs) const;
    /// Half of the solution for a right-hand side that is zero but for these nodes. For systems with nodes.
    HalfSolution half_solve(std::vector<int> nodes, const std::vector<Vec3>& values) const;
    /// out = matrix * in.
    void multiply(const Coordinates& in, Coordinates& out) const;

private:
    struct SparseFactor;
    bool is_sparse() const;
    bool factorize_sparse();

    BlockPattern m_pattern;
    std::vector<Mat6> m_diagonal, m_off_diagonal;
    std::vector<Mat3> m_node_diagonal, m_node_pairs;
    std::vector<Mat63> m_mixed_pairs;
    std::vector<int> m_node_first, m_mixed_first;  // where the pairs of each node, of each body begin
    SmallCholesky<6> m_single;                     // factor of one body
    MatrixX m_dense;                               // Cholesky factor of a few
    std::unique_ptr<SparseFactor> m_sparse;
    bool m_pattern_changed = true;
};

}  // namespace diffsim
