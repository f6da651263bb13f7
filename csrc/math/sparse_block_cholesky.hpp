#pragma once

#include <cstddef>
#include <memory>
#include <utility>
#include <vector>

namespace diffsim {

/// L⁻¹ b of a sparse Cholesky factor L: the numbers that can differ from zero.
struct HalfSolution {
    std::vector<int> groups;         ///< of rows, ascending
    std::vector<std::size_t> start;  ///< of each group's numbers, and the end of all
    std::vector<double> values;

    /// bᵀ A⁻¹ c  of two such right-hand sides.
    double dot(const HalfSolution& other) const;
};

/// Cholesky factorization of a sparse symmetric positive definite matrix of small dense blocks (3 and 6 rows; any
/// other size works too).
///
/// Multifrontal: columns of like pattern are eliminated together, in a small dense matrix, and what that leaves is
/// handed to their parent in the elimination tree  [liu1992multifrontal]. The order of all sums is fixed by the
/// pattern. One object serves one thread at a time, solve_in_place() included: it uses the object's work space.
class SparseBlockCholesky {
public:
    /// sizes: rows of each diagonal block. pairs: (i < j), unique, sorted: blocks above the diagonal that may be
    /// non-zero.
    void analyze(const std::vector<int>& sizes, const std::vector<std::pair<int, int>>& pairs);

    /// diagonal[i]: sizes[i] x sizes[i]; upper[k]: block of pairs[k], sizes[first] x sizes[second]; all column-major.
    /// Of a diagonal block only the lower triangle is read. False if the matrix is not positive definite (or not
    /// finite). Allocates nothing.
    bool factorize(const double* const* diagonal, const double* const* upper);

    /// x in natural block order, concatenated. Overwritten by the solution. Needs a successful factorize(). Allocates
    /// nothing.
    void solve_in_place(double* x) const;

    /// L⁻¹ b  of a right-hand side b with few blocks that are not zero: their numbers, and the values block by block.
    /// Needs a successful factorize(). It takes a small part of the time of solve_in_place(), that of the factor's
    /// columns which these blocks reach.
    void half_solve(const std::vector<int>& blocks, const double* values, HalfSolution& result) const;

    int rows() const { return m_row_count; }

private:
    /// Storage that grows and never shrinks; its content does not survive growing.
    class Buffer {
    public:
        void reserve(std::size_t count);
        double* data() const { return m_data.get(); }

    private:
        std::unique_ptr<double[]> m_data;
        std::size_t m_capacity = 0;
    };

    /// `count` consecutive indices.
    struct Run {
        int from, to, count;
    };

    /// One block of the matrix and its place in its front.
    struct Entry {
        int block;  ///< number of the pair, or ~i for the diagonal block i
        bool transposed;
        int row, column;              ///< in the front, of the first entry
        int row_count, column_count;  ///< in the front
    };

    /// Columns eliminated together. Its front has the rows  [own columns, padding | rows below, padding].
    struct Supernode {
        int first = 0;         ///< of its own columns, in the order of elimination
        int parent = -1;       ///< -1: none
        int width = 0;         ///< own columns
        int padded_width = 0;  ///< with padding to whole tiles, as are the rows below
        int padded_below = 0;
        std::size_t factor = 0;   ///< offset of its part of the factor
        std::size_t inverse = 0;  ///< offset of its inverse diagonal
        std::size_t update = 0;   ///< offset of its update matrix on its stack
        int stack = 0;            ///< the parity of its depth in the tree
        int child_begin = 0, child_end = 0;
        int entry_begin = 0, entry_end = 0;
        int solve_run_begin = 0, solve_run_end = 0;
        int parent_run_begin = 0, parent_run_split = 0, parent_run_end = 0;
    };

    struct Analysis;
    void number_rows(Analysis& analysis);
    /// Where the rows, the matrix's blocks and the children's updates of a supernode stand in its front.
    void map_rows(Analysis& analysis, int s);
    void map_entries(const Analysis& analysis, int s);
    void map_children(const Analysis& analysis, int s);
    static void append_run(std::vector<Run>& runs, int begin, const Run& run);
    void reserve_storage();
    /// x = L⁻¹ x of one supernode, which takes from the rows above it too. `own` receives its own numbers.
    void eliminate(const Supernode& node, double* x, double* own) const;

    /// A part of a front, column-major.
    struct Target {
        double* first;
        std::ptrdiff_t stride;
        int origin;  ///< row and column of `first` in the front
    };

    /// The panel of a front: the matrix's blocks and the children's updates. Its update matrix gets theirs later, since
    /// the elimination overwrites it.
    void assemble_panel(const Supernode& node, const double* const* diagonal, const double* const* upper);
    void assemble_update(const Supernode& node);
    /// Adds columns of a child's update matrix, those of some of its runs, to a part of its parent's front.
    void add_columns(const Supernode& child, int run_begin, int run_end, const Target& target);

    int m_row_count = 0;
    std::size_t m_factor_size = 0;
    std::vector<Run> m_permutation;       ///< from: natural order; to: order of elimination
    std::vector<Supernode> m_supernodes;  ///< in postorder
    std::vector<int> m_children;
    std::vector<Entry> m_entries;
    std::vector<Run> m_solve_runs;   ///< from: order of elimination; to: row of the front, counted below its panel
    std::vector<Run> m_parent_runs;  ///< from: row of the update matrix; to: row of the parent's front

    std::vector<int> m_block_sizes, m_node_of_block, m_first_row;  ///< per block; its row in the order of elimination

    Buffer m_factor, m_inverse_diagonal;
    Buffer m_panel, m_stacks[2];               // work space of factorize()
    Buffer m_solution, m_front_x, m_partials;  // work space of solve_in_place()
    mutable std::vector<char> m_reached;       // and of half_solve()
};

}  // namespace diffsim
