#include "math/sparse_block_cholesky.hpp"

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>
#include <algorithm>
#include <cassert>
#include <cstddef>
#include <utility>

#include "math/cholesky_front.hpp"
#include "math/nested_dissection.hpp"

namespace diffsim {
namespace {

constexpr int kTile = kCholeskyTile;

constexpr int padded(int count) { return (count + kTile - 1) / kTile * kTile; }

/// Neighbours of each block, both ways. `pair` is the number of the pair they come from.
struct Graph {
    std::vector<int> start, neighbor, pair;
};

Graph make_graph(int count, const std::vector<std::pair<int, int>>& pairs) {
    Graph graph;
    graph.start.assign(static_cast<std::size_t>(count) + 1, 0);
    for (const auto& [i, j] : pairs) {
        assert(0 <= i && i < j && j < count);
        ++graph.start[i + 1];
        ++graph.start[j + 1];
    }
    for (int i = 0; i < count; ++i) graph.start[i + 1] += graph.start[i];
    graph.neighbor.resize(2 * pairs.size());
    graph.pair.resize(2 * pairs.size());
    std::vector<int> next(graph.start.begin(), graph.start.end() - 1);
    for (int k = 0; k < static_cast<int>(pairs.size()); ++k) {
        const auto [i, j] = pairs[k];
        graph.neighbor[next[i]] = j;
        graph.pair[next[i]++] = k;
        graph.neighbor[next[j]] = i;
        graph.pair[next[j]++] = k;
    }
    return graph;
}

/// The block that comes at each place of an order with little fill: approximate minimum degree  [amestoy1996amd].
std::vector<int> minimum_degree_order(const Graph& graph) {
    const int count = static_cast<int>(graph.start.size()) - 1;
    Eigen::SparseMatrix<char> pattern(count, count);  // Eigen's ordering wants the diagonal too
    pattern.resizeNonZeros(static_cast<Eigen::Index>(graph.neighbor.size()) + count);
    int* const outer = pattern.outerIndexPtr();
    int* const inner = pattern.innerIndexPtr();
    int next = 0;
    for (int i = 0; i < count; ++i) {
        outer[i] = next;
        inner[next++] = i;
        for (int k = graph.start[i]; k < graph.start[i + 1]; ++k) inner[next++] = graph.neighbor[k];
    }
    outer[count] = next;
    Eigen::PermutationMatrix<Eigen::Dynamic, Eigen::Dynamic, int> order;
    Eigen::internal::minimum_degree_ordering(pattern, order);
    return std::vector<int>(order.indices().data(), order.indices().data() + count);
}

std::vector<int> inverse_of(const std::vector<int>& order) {
    std::vector<int> position(order.size());
    for (std::size_t k = 0; k < order.size(); ++k) position[order[k]] = static_cast<int>(k);
    return position;
}

/// A column of the elimination tree.
struct Column {
    int parent = -1;   ///< -1: none
    int below = 0;     ///< scalar rows of the factor below the column's block
    int visitor = -1;  ///< the last row that passed
};

std::vector<Column> make_tree(const Graph& graph, const std::vector<int>& order, const std::vector<int>& sizes) {
    const std::vector<int> position = inverse_of(order);
    std::vector<Column> columns(order.size());
    for (int i = 0; i < static_cast<int>(order.size()); ++i) {
        const int block = order[i];
        columns[i].visitor = i;
        for (int k = graph.start[block]; k < graph.start[block + 1]; ++k) {
            // Row i of the factor is non-zero in the columns on the way from the neighbour up to i.
            const int neighbor = position[graph.neighbor[k]];
            if (neighbor > i) continue;
            for (Column* column = &columns[neighbor]; column->visitor != i; column = &columns[column->parent]) {
                if (column->parent < 0) column->parent = i;
                column->below += sizes[block];
                column->visitor = i;
            }
        }
    }
    return columns;
}

/// Lists of items per owner, ascending.
struct Lists {
    std::vector<int> head, next;
    explicit Lists(std::size_t count) : head(count, -1), next(count, -1) {}
    void push_front(int owner, int item) {
        next[item] = head[owner];
        head[owner] = item;
    }
};

constexpr int kNotANode = -2;

/// Children before parents, each subtree in one piece. Items whose parent is kNotANode are left out.
std::vector<int> postorder(const std::vector<int>& parent) {
    const int count = static_cast<int>(parent.size());
    Lists children(parent.size() + 1);  // the last list holds the roots
    for (int i = count - 1; i >= 0; --i)
        if (parent[i] != kNotANode) children.push_front(parent[i] < 0 ? count : parent[i], i);
    std::vector<int> result, stack;
    result.reserve(parent.size());
    for (int root = children.head[count]; root >= 0; root = children.next[root]) {
        stack.push_back(root);
        while (!stack.empty()) {
            const int node = stack.back();
            const int child = children.head[node];
            if (child >= 0) {
                children.head[node] = children.next[child];
                stack.push_back(child);
            } else {
                result.push_back(node);
                stack.pop_back();
            }
        }
    }
    return result;
}

/// Time to eliminate a front, in about processor cycles, measured. The result is not sensitive to them: without those per
/// front and tile, or with three times as much, factorizations took at most a tenth longer.
double elimination_cost(int width, int below) {
    constexpr double kPerFront = 300.0, kPerTile = 25.0, kPerTileColumn = 8.0, kPerUpdateTile = 25.0;
    const double w = padded(width) / kTile, b = padded(below) / kTile;
    const double panel_tiles = w * (w + 1.0) / 2.0 + w * b, update_tiles = b * (b + 1.0) / 2.0;
    const double panel_columns = kTile * (w * (w - 1.0) * (w + 1.0) / 6.0 + b * w * (w - 1.0) / 2.0);
    const double update_columns = kTile * w * update_tiles;
    return kPerFront + kPerTile * (panel_tiles + update_tiles) + kPerTileColumn * (panel_columns + update_columns) +
           kPerUpdateTile * update_tiles;
}

/// Groups of columns with parents among the groups, in postorder.
struct Partition {
    std::vector<int> order;   ///< blocks, group by group
    std::vector<int> end;     ///< where each group ends in `order`
    std::vector<int> parent;  ///< of the groups; -1: none
    std::vector<int> width, below;
};

/// Columns of the same pattern, then merged with their parents as long as that saves time.
Partition make_partition(
    const std::vector<Column>& tree, const std::vector<int>& order, const std::vector<int>& sizes) {
    const int count = static_cast<int>(order.size());
    std::vector<int> column_parent(order.size());
    for (int i = 0; i < count; ++i) column_parent[i] = tree[i].parent;
    const std::vector<int> columns = postorder(column_parent);
    std::vector<int> group_of(order.size()), first, last, width, below;
    for (int k = 0; k < count; ++k) {
        const int column = columns[k], size = sizes[order[column]];
        const bool joins =
            k > 0 && tree[columns[k - 1]].parent == column && tree[columns[k - 1]].below == tree[column].below + size;
        if (!joins) {
            first.push_back(k);
            last.push_back(k);
            width.push_back(0);
            below.push_back(0);
        }
        last.back() = k;
        width.back() += size;
        below.back() = tree[column].below;
        group_of[column] = static_cast<int>(first.size()) - 1;
    }

    const int group_count = static_cast<int>(first.size());
    std::vector<int> parent(first.size(), -1), merged_into(first.size(), -1);
    Lists children(first.size());
    for (int g = group_count - 1; g >= 0; --g) {
        const int above = column_parent[columns[last[g]]];
        if (above < 0) continue;
        parent[g] = group_of[above];
        children.push_front(parent[g], g);
    }
    std::vector<double> cost(first.size());
    for (int g = 0; g < group_count; ++g) {
        cost[g] = elimination_cost(width[g], below[g]);
        for (int child = children.head[g]; child >= 0; child = children.next[child]) {
            const double together = elimination_cost(width[g] + width[child], below[g]);
            if (together > cost[g] + cost[child]) continue;
            cost[g] = together;
            width[g] += width[child];
            merged_into[child] = g;
        }
    }

    // Parents come later than their children, so that going down finds them merged already.
    Lists members(first.size());
    std::vector<int> keeper(first.size()), kept_parent(first.size(), kNotANode);
    for (int g = group_count - 1; g >= 0; --g) {
        keeper[g] = merged_into[g] < 0 ? g : keeper[merged_into[g]];
        members.push_front(keeper[g], g);
        if (keeper[g] == g) kept_parent[g] = parent[g] < 0 ? -1 : keeper[parent[g]];
    }
    const std::vector<int> kept = postorder(kept_parent);
    std::vector<int> place(first.size());
    for (std::size_t k = 0; k < kept.size(); ++k) place[kept[k]] = static_cast<int>(k);

    Partition partition;
    partition.order.reserve(order.size());
    for (const int g : kept) {
        for (int member = members.head[g]; member >= 0; member = members.next[member])
            for (int k = first[member]; k <= last[member]; ++k) partition.order.push_back(order[columns[k]]);
        partition.end.push_back(static_cast<int>(partition.order.size()));
        partition.parent.push_back(kept_parent[g] < 0 ? -1 : place[kept_parent[g]]);
        partition.width.push_back(width[g]);
        partition.below.push_back(below[g]);
    }
    return partition;
}

double elimination_cost(const Partition& partition) {
    double cost = 0.0;
    for (std::size_t g = 0; g < partition.end.size(); ++g)
        cost += elimination_cost(partition.width[g], partition.below[g]);
    return cost;
}

/// By minimum degree, or by nested dissection where that is faster, which it mostly is from some thousand blocks on.
Partition find_partition(const Graph& graph, const std::vector<int>& sizes) {
    // Not tried where it would take more than about a third of a factorization, which tends to be where it gains
    // nothing: on small, thin and loosely coupled graphs.
    constexpr double kPerNeighbor = 2000.0, kPerBlock = 8000.0;
    const std::vector<int> order = minimum_degree_order(graph);
    Partition partition = make_partition(make_tree(graph, order, sizes), order, sizes);
    const double cost = elimination_cost(partition);
    if (cost <
        kPerNeighbor * static_cast<double>(graph.neighbor.size()) + kPerBlock * static_cast<double>(sizes.size()))
        return partition;
    const std::vector<int> dissected = nested_dissection({graph.start, graph.neighbor}, sizes, order).order;
    Partition other = make_partition(make_tree(graph, dissected, sizes), dissected, sizes);
    if (elimination_cost(other) < cost) partition = std::move(other);
    return partition;
}

/// For each group the places in the order of the blocks below it, ascending.
struct RowLists {
    std::vector<int> start, row;
};

RowLists make_row_lists(const Graph& graph, const Partition& partition, const std::vector<int>& group_of) {
    const int count = static_cast<int>(partition.order.size()), group_count = static_cast<int>(partition.end.size());
    const std::vector<int> position = inverse_of(partition.order);
    std::vector<int> visitor(partition.end.size(), -1);
    std::vector<std::pair<int, int>> found;  // group, row
    RowLists lists;
    lists.start.assign(partition.end.size() + 1, 0);
    for (int i = 0; i < count; ++i) {
        const int block = partition.order[i];
        visitor[group_of[i]] = i;
        for (int k = graph.start[block]; k < graph.start[block + 1]; ++k) {
            const int column = position[graph.neighbor[k]];
            if (column > i) continue;
            for (int g = group_of[column]; visitor[g] != i; g = partition.parent[g]) {
                visitor[g] = i;
                found.emplace_back(g, i);
                ++lists.start[g + 1];
            }
        }
    }
    for (int g = 0; g < group_count; ++g) lists.start[g + 1] += lists.start[g];
    std::vector<int> next(lists.start.begin(), lists.start.end() - 1);
    lists.row.resize(found.size());
    for (const auto& [g, row] : found) lists.row[next[g]++] = row;
    return lists;
}

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
    Graph graph;
    Partition partition;  ///< into supernodes
    std::vector<int> place_of_block;
    std::vector<int> node_of_place;
    std::vector<int> start_of_place;  ///< first scalar row
    RowLists rows;
    Lists children;              ///< of the supernodes
    std::vector<int> front_row;  ///< of each place, in the front being looked at

    int begin(int node) const { return node == 0 ? 0 : partition.end[node - 1]; }
    int end(int node) const { return partition.end[node]; }
    int size_at(int place) const { return sizes[partition.order[place]]; }
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

    Graph graph = make_graph(static_cast<int>(sizes.size()), pairs);
    Partition partition = find_partition(graph, sizes);
    const std::size_t node_count = partition.end.size();
    Analysis analysis{sizes, std::move(graph), std::move(partition), {}, {}, {}, {}, Lists(node_count), {}};

    m_supernodes.resize(node_count);
    number_rows(analysis);
    analysis.rows = make_row_lists(analysis.graph, analysis.partition, analysis.node_of_place);
    analysis.front_row.resize(sizes.size());
    for (int s = static_cast<int>(node_count) - 1; s >= 0; --s) {
        const int parent = analysis.partition.parent[s];
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
    analysis.place_of_block = inverse_of(analysis.partition.order);
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
            const int block = analysis.partition.order[place];
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
    node.width = analysis.partition.width[s];
    node.padded_width = padded(node.width);
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
    assert(below == analysis.partition.below[s]);
    node.padded_below = padded(below);
}

void SparseBlockCholesky::map_entries(const Analysis& analysis, int s) {
    const Graph& graph = analysis.graph;
    Supernode& node = m_supernodes[s];
    node.entry_begin = static_cast<int>(m_entries.size());
    for (int place = analysis.begin(s); place < analysis.end(s); ++place) {
        const int block = analysis.partition.order[place], size = analysis.sizes[block];
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
    m_partials.reserve(kTile * width);
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
        std::fill(z + rows - std::min(kTile, node.padded_below), z + rows, 0.0);
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
