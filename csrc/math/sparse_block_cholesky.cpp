#include "math/sparse_block_cholesky.hpp"

#include <algorithm>
#include <cassert>
#include <cstddef>
#include <utility>

#include "math/cholesky_front.hpp"
#include "math/supernodes.hpp"

namespace diffsim {
namespace {

template <int kRows, int kColumns>
void copy_block(const double* from, double* to, std::ptrdiff_t stride) {
    for (int c = 0; c < kColumns; ++c)
        for (int r = 0; r < kRows; ++r) to[c * stride + r] = from[c * kRows + r];
}

template <int kRows, int kColumns>
void copy_transposed(const double* from, double* to, std::ptrdiff_t stride) {
    for (int c = 0; c < kColumns; ++c)
        for (int r = 0; r < kRows; ++r) to[c * stride + r] = from[r * kColumns + c];
}

}  // namespace

void SparseBlockCholesky::Buffer::reserve(std::size_t count) {
    if (count <= m_capacity) return;
    m_data.reset();
    m_capacity = count + count / 4;
    m_data.reset(new double[m_capacity]);
}

/// What analyze() knows of the matrix. A block's place is its position in the order of elimination.
struct SparseBlockCholesky::Analysis {
    const std::vector<int>& sizes;  ///< of the blocks in natural order
    BlockGraph graph;
    Supernodes supernodes;
    std::vector<int> place_of_block;
    std::vector<int> node_of_place;
    std::vector<int> start_of_place;  ///< first scalar row
    SupernodeRows rows;
    ItemLists children;          ///< of the supernodes
    std::vector<int> front_row;  ///< of each place, in the front being looked at

    int begin(int node) const { return node == 0 ? 0 : supernodes.end[node - 1]; }
    int end(int node) const { return supernodes.end[node]; }
    int size_at(int place) const { return sizes[supernodes.order[place]]; }
};

void SparseBlockCholesky::analyze(const std::vector<int>& sizes, const std::vector<std::pair<int, int>>& pairs) {
    m_supernodes.clear();
    m_permutation.clear();
    m_children.clear();
    m_entries.clear();
    m_solve_runs.clear();
    m_parent_runs.clear();
    m_block_sizes = sizes;
    m_row_count = 0;
    m_factor_size = 0;
    if (sizes.empty()) return;

    BlockGraph graph = make_block_graph(static_cast<int>(sizes.size()), pairs);
    Supernodes supernodes = find_supernodes(graph, sizes);
    const std::size_t node_count = supernodes.end.size();
    Analysis analysis{sizes, std::move(graph), std::move(supernodes), {}, {}, {}, {}, ItemLists(node_count), {}};

    m_supernodes.resize(node_count);
    number_rows(analysis);
    analysis.rows = rows_below(analysis.graph, analysis.supernodes, analysis.node_of_place);
    analysis.front_row.resize(sizes.size());
    for (int s = static_cast<int>(node_count) - 1; s >= 0; --s) {
        const int parent = analysis.supernodes.parent[s];
        m_supernodes[s].parent = parent;
        if (parent >= 0) analysis.children.push_front(parent, s);
        m_supernodes[s].stack = parent < 0 ? 0 : 1 - m_supernodes[parent].stack;
    }
    m_entries.reserve(sizes.size() + pairs.size());
    m_children.reserve(node_count);
    for (int s = 0; s < static_cast<int>(node_count); ++s) {
        map_rows(analysis, s);
        map_entries(analysis, s);
        map_children(analysis, s);
    }
    reserve_storage();
}

void SparseBlockCholesky::number_rows(Analysis& analysis) {
    const std::size_t count = analysis.sizes.size();
    std::vector<int> natural_start(count);
    for (std::size_t i = 1; i < count; ++i) natural_start[i] = natural_start[i - 1] + analysis.sizes[i - 1];
    analysis.place_of_block = inverse_of(analysis.supernodes.order);
    analysis.node_of_place.resize(count);
    analysis.start_of_place.resize(count);
    m_node_of_block.resize(count);
    m_first_row.resize(count);
    for (int s = 0; s < static_cast<int>(m_supernodes.size()); ++s) {
        m_supernodes[s].first = m_row_count;
        for (int place = analysis.begin(s); place < analysis.end(s); ++place) {
            const int size = analysis.size_at(place);
            analysis.node_of_place[place] = s;
            analysis.start_of_place[place] = m_row_count;
            const int block = analysis.supernodes.order[place];
            m_node_of_block[block] = s;
            m_first_row[block] = m_row_count;
            m_permutation.push_back({natural_start[block], m_row_count, size});
            m_row_count += size;
        }
    }
}

void SparseBlockCholesky::append_run(std::vector<Run>& runs, int begin, const Run& run) {
    if (static_cast<int>(runs.size()) > begin) {
        Run& last = runs.back();
        if (last.from + last.count == run.from && last.to + last.count == run.to) {
            last.count += run.count;
            return;
        }
    }
    runs.push_back(run);
}

void SparseBlockCholesky::map_rows(Analysis& analysis, int s) {
    Supernode& node = m_supernodes[s];
    node.width = analysis.supernodes.width[s];
    node.padded_width = padded_to_tiles(node.width);
    for (int place = analysis.begin(s); place < analysis.end(s); ++place)
        analysis.front_row[place] = analysis.start_of_place[place] - node.first;

    int below = 0;
    node.solve_run_begin = static_cast<int>(m_solve_runs.size());
    for (int k = analysis.rows.start[s]; k < analysis.rows.start[s + 1]; ++k) {
        const int place = analysis.rows.row[k], size = analysis.size_at(place);
        analysis.front_row[place] = node.padded_width + below;
        append_run(m_solve_runs, node.solve_run_begin, {analysis.start_of_place[place], below, size});
        below += size;
    }
    node.solve_run_end = static_cast<int>(m_solve_runs.size());
    assert(below == analysis.supernodes.below[s]);
    node.padded_below = padded_to_tiles(below);
}

void SparseBlockCholesky::map_entries(const Analysis& analysis, int s) {
    const BlockGraph& graph = analysis.graph;
    Supernode& node = m_supernodes[s];
    node.entry_begin = static_cast<int>(m_entries.size());
    for (int place = analysis.begin(s); place < analysis.end(s); ++place) {
        const int block = analysis.supernodes.order[place], size = analysis.sizes[block];
        const int column = analysis.front_row[place];
        m_entries.push_back({~block, false, column, column, size, size});
        for (int k = graph.start[block]; k < graph.start[block + 1]; ++k) {
            const int other = graph.neighbor[k], other_place = analysis.place_of_block[other];
            if (other_place < place) continue;  // stands in the other's column
            const int row = analysis.front_row[other_place];
            m_entries.push_back({graph.pair[k], block < other, row, column, analysis.sizes[other], size});
        }
    }
    node.entry_end = static_cast<int>(m_entries.size());
}

void SparseBlockCholesky::map_children(const Analysis& analysis, int s) {
    Supernode& node = m_supernodes[s];
    node.child_begin = static_cast<int>(m_children.size());
    for (int c = analysis.children.head[s]; c >= 0; c = analysis.children.next[c]) {
        m_children.push_back(c);
        Supernode& child = m_supernodes[c];
        int k = analysis.rows.start[c], from = 0;
        const auto append_until = [&](int place_end) {
            const int first_run = static_cast<int>(m_parent_runs.size());
            for (; k < analysis.rows.start[c + 1] && analysis.rows.row[k] < place_end; ++k) {
                const int place = analysis.rows.row[k], size = analysis.size_at(place);
                append_run(m_parent_runs, first_run, {from, analysis.front_row[place], size});
                from += size;
            }
            return static_cast<int>(m_parent_runs.size());
        };
        child.parent_run_begin = static_cast<int>(m_parent_runs.size());
        child.parent_run_split = append_until(analysis.end(s));
        child.parent_run_end = append_until(static_cast<int>(analysis.sizes.size()));
    }
    node.child_end = static_cast<int>(m_children.size());
}

void SparseBlockCholesky::reserve_storage() {
    std::size_t inverse_size = 0, panel_size = 0, front_rows = 0, width = 0;
    // Update matrices live from their own elimination until their parent's. Those of even and odd depth go on two
    // stacks, so that the parent's never lies in the way of its children's.
    std::size_t top[2] = {0, 0}, highest[2] = {0, 0};
    for (Supernode& node : m_supernodes) {
        const std::size_t node_width = static_cast<std::size_t>(node.padded_width);
        const std::size_t below = static_cast<std::size_t>(node.padded_below), rows = node_width + below;
        node.factor = m_factor_size;
        node.inverse = inverse_size;
        m_factor_size += rows * node_width;
        inverse_size += node_width;
        panel_size = std::max(panel_size, rows * node_width);
        front_rows = std::max(front_rows, rows);
        width = std::max(width, node_width);

        node.update = top[node.stack];
        top[node.stack] += below * below;
        highest[node.stack] = std::max(highest[node.stack], top[node.stack]);
        if (node.child_begin < node.child_end) top[1 - node.stack] = m_supernodes[m_children[node.child_begin]].update;
    }
    m_factor.reserve(m_factor_size);
    m_inverse_diagonal.reserve(inverse_size);
    m_panel.reserve(panel_size);
    for (int parity = 0; parity < 2; ++parity) m_stacks[parity].reserve(highest[parity]);
    m_solution.reserve(static_cast<std::size_t>(m_row_count));
    m_front_x.reserve(front_rows);
    m_partials.reserve(kCholeskyTile * width);
    m_reached.assign(m_supernodes.size(), 0);
}

void SparseBlockCholesky::assemble_panel(
    const Supernode& node, const double* const* diagonal, const double* const* upper) {
    const std::ptrdiff_t stride = node.padded_width + node.padded_below;
    double* const panel = m_panel.data();
    std::fill(panel, panel + stride * node.padded_width, 0.0);
    for (int c = node.width; c < node.padded_width; ++c) panel[c * stride + c] = 1.0;

    for (int e = node.entry_begin; e < node.entry_end; ++e) {
        const Entry& entry = m_entries[e];
        double* const to = panel + entry.column * stride + entry.row;
        const int row_count = entry.row_count, column_count = entry.column_count;
        const double* const from = entry.block < 0 ? diagonal[~entry.block] : upper[entry.block];
        if (row_count == 3 && column_count == 3) {
            entry.transposed ? copy_transposed<3, 3>(from, to, stride) : copy_block<3, 3>(from, to, stride);
        } else if (row_count == 6 && column_count == 6) {
            entry.transposed ? copy_transposed<6, 6>(from, to, stride) : copy_block<6, 6>(from, to, stride);
        } else {
            const int row_step = entry.transposed ? column_count : 1, column_step = entry.transposed ? 1 : row_count;
            for (int c = 0; c < column_count; ++c)
                for (int r = 0; r < row_count; ++r) to[c * stride + r] = from[c * column_step + r * row_step];
        }
    }

    for (int k = node.child_begin; k < node.child_end; ++k) {
        const Supernode& child = m_supernodes[m_children[k]];
        add_columns(child, child.parent_run_begin, child.parent_run_split, {panel, stride, 0});
    }
}

void SparseBlockCholesky::assemble_update(const Supernode& node) {
    const Target target{m_stacks[node.stack].data() + node.update, node.padded_below, node.padded_width};
    for (int k = node.child_begin; k < node.child_end; ++k) {
        const Supernode& child = m_supernodes[m_children[k]];
        add_columns(child, child.parent_run_split, child.parent_run_end, target);
    }
}

void SparseBlockCholesky::add_columns(const Supernode& child, int run_begin, int run_end, const Target& target) {
    const double* const update = m_stacks[child.stack].data() + child.update;
    for (int q = run_begin; q < run_end; ++q) {
        const Run& columns = m_parent_runs[q];
        for (int i = 0; i < columns.count; ++i) {
            const double* const from = update + static_cast<std::ptrdiff_t>(columns.from + i) * child.padded_below;
            double* const to = target.first + (columns.to - target.origin + i) * target.stride;
            for (int p = q; p < child.parent_run_end; ++p) {
                const Run& rows = m_parent_runs[p];
                const double* const from_rows = from + rows.from;
                double* const to_rows = to + (rows.to - target.origin);
                for (int r = p == q ? i : 0; r < rows.count; ++r) to_rows[r] += from_rows[r];
            }
        }
    }
}

bool SparseBlockCholesky::factorize(const double* const* diagonal, const double* const* upper) {
    const CholeskyKernels& kernels = cholesky_kernels();
    for (const Supernode& node : m_supernodes) {
        assemble_panel(node, diagonal, upper);
        const CholeskyFront front{
            node.padded_width,
            node.padded_below,
            m_panel.data(),
            m_factor.data() + node.factor,
            m_inverse_diagonal.data() + node.inverse,
            m_stacks[node.stack].data() + node.update};
        if (!kernels.factorize(front)) return false;
        assemble_update(node);
    }
    return true;
}

void SparseBlockCholesky::eliminate(const Supernode& node, double* x, double* own) const {
    double* const z = m_front_x.data();
    const int width = node.padded_width, rows = width + node.padded_below;
    std::copy_n(x + node.first, node.width, z);
    std::fill(z + node.width, z + rows, 0.0);
    cholesky_kernels().solve(m_factor.data() + node.factor, m_inverse_diagonal.data() + node.inverse, width, rows, z);
    std::copy_n(z, node.width, own);
    for (int k = node.solve_run_begin; k < node.solve_run_end; ++k) {
        const Run& run = m_solve_runs[k];
        for (int i = 0; i < run.count; ++i) x[run.from + i] += z[width + run.to + i];
    }
}

void SparseBlockCholesky::half_solve(const std::vector<int>& blocks, const double* values, HalfSolution& result) const {
    double* const y = m_solution.data();
    result.groups.clear();
    for (const int block : blocks) {
        for (int s = m_node_of_block[block]; s >= 0 && m_reached[s] == 0; s = m_supernodes[s].parent) {
            m_reached[s] = 1;
            result.groups.push_back(s);
        }
    }
    std::sort(result.groups.begin(), result.groups.end());
    for (const int s : result.groups) std::fill_n(y + m_supernodes[s].first, m_supernodes[s].width, 0.0);
    for (const int block : blocks) {
        const int size = m_block_sizes[block];
        for (int i = 0; i < size; ++i) y[m_first_row[block] + i] += values[i];
        values += size;
    }
    result.start.assign(1, 0);
    for (const int s : result.groups)
        result.start.push_back(result.start.back() + static_cast<std::size_t>(m_supernodes[s].width));
    result.values.resize(result.start.back());
    for (std::size_t k = 0; k < result.groups.size(); ++k) {
        const int s = result.groups[k];
        eliminate(m_supernodes[s], y, result.values.data() + result.start[k]);
        m_reached[s] = 0;
    }
}

double HalfSolution::dot(const HalfSolution& other) const {
    double sum = 0.0;
    std::size_t i = 0, j = 0;
    while (i < groups.size() && j < other.groups.size()) {
        if (groups[i] < other.groups[j]) {
            ++i;
        } else if (groups[i] > other.groups[j]) {
            ++j;
        } else {
            const double* const a = values.data() + start[i];
            const double* const b = other.values.data() + other.start[j];
            const std::size_t count = start[i + 1] - start[i];
            for (std::size_t k = 0; k < count; ++k) sum += a[k] * b[k];
            ++i;
            ++j;
        }
    }
    return sum;
}

void SparseBlockCholesky::solve_in_place(double* x) const {
    const CholeskyKernels& kernels = cholesky_kernels();
    double* const y = m_solution.data();
    double* const z = m_front_x.data();
    for (const Run& run : m_permutation) std::copy_n(x + run.from, run.count, y + run.to);

    for (const Supernode& node : m_supernodes) eliminate(node, y, y + node.first);
    for (auto s = m_supernodes.rbegin(); s != m_supernodes.rend(); ++s) {
        const Supernode& node = *s;
        const int width = node.padded_width, rows = width + node.padded_below;
        std::copy_n(y + node.first, node.width, z);
        std::fill(z + node.width, z + width, 0.0);
        std::fill(z + rows - std::min(kCholeskyTile, node.padded_below), z + rows, 0.0);
        for (int k = node.solve_run_begin; k < node.solve_run_end; ++k) {
            const Run& run = m_solve_runs[k];
            std::copy_n(y + run.from, run.count, z + width + run.to);
        }
        kernels.solve_transposed(
            m_factor.data() + node.factor, m_inverse_diagonal.data() + node.inverse, width, rows, z, m_partials.data());
        std::copy_n(z, node.width, y + node.first);
    }

    for (const Run& run : m_permutation) std::copy_n(y + run.to, run.count, x + run.from);
}

}  // namespace diffsim
