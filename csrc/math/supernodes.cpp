#include "math/supernodes.hpp"

#include <Eigen/OrderingMethods>
#include <Eigen/SparseCore>
#include <cassert>

#include "math/cholesky_front.hpp"
#include "math/nested_dissection.hpp"

namespace diffsim {
namespace {

/// The block that comes at each place of an order with little fill: approximate minimum degree  [amestoy1996amd].
std::vector<int> minimum_degree_order(const BlockGraph& graph) {
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

/// A column of the elimination tree.
struct Column {
    int parent = -1;   ///< -1: none
    int below = 0;     ///< scalar rows of the factor below the column's block
    int visitor = -1;  ///< the last row that passed
};

std::vector<Column> make_tree(const BlockGraph& graph, const std::vector<int>& order, const std::vector<int>& sizes) {
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

constexpr int kNotANode = -2;

/// Children before parents, each subtree in one piece. Items whose parent is kNotANode are left out.
std::vector<int> postorder(const std::vector<int>& parent) {
    const int count = static_cast<int>(parent.size());
    ItemLists children(parent.size() + 1);  // the last list holds the roots
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

/// Time to eliminate a front, in about processor cycles, measured. The result is not sensitive to them: without those
/// per front and tile, or with three times as much, factorizations took at most a tenth longer.
double elimination_cost(int width, int below) {
    constexpr double kPerFront = 300.0, kPerTile = 25.0, kPerTileColumn = 8.0, kPerUpdateTile = 25.0;
    const double w = padded_to_tiles(width) / kCholeskyTile, b = padded_to_tiles(below) / kCholeskyTile;
    const double panel_tiles = w * (w + 1.0) / 2.0 + w * b, update_tiles = b * (b + 1.0) / 2.0;
    const double panel_columns = kCholeskyTile * (w * (w - 1.0) * (w + 1.0) / 6.0 + b * w * (w - 1.0) / 2.0);
    const double update_columns = kCholeskyTile * w * update_tiles;
    return kPerFront + kPerTile * (panel_tiles + update_tiles) + kPerTileColumn * (panel_columns + update_columns) +
           kPerUpdateTile * update_tiles;
}

/// Columns that follow each other in a postorder and have the same pattern, by groups.
struct ColumnGroups {
    std::vector<int> columns;       ///< in postorder
    std::vector<int> first, last;   ///< per group: into the columns
    std::vector<int> width, below;  ///< scalar columns, and scalar rows below them
    std::vector<int> parent;        ///< -1: none

    int count() const { return static_cast<int>(first.size()); }
};

ColumnGroups group_columns(
    const std::vector<Column>& tree, const std::vector<int>& order, const std::vector<int>& sizes) {
    const int count = static_cast<int>(order.size());
    std::vector<int> column_parent(order.size());
    for (int i = 0; i < count; ++i) column_parent[i] = tree[i].parent;
    ColumnGroups groups;
    groups.columns = postorder(column_parent);
    auto& [columns, first, last, width, below, parent] = groups;
    std::vector<int> group_of(order.size());
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
        group_of[column] = groups.count() - 1;
    }
    parent.assign(first.size(), -1);
    for (int g = 0; g < groups.count(); ++g) {
        const int above = column_parent[columns[last[g]]];
        if (above >= 0) parent[g] = group_of[above];
    }
    return groups;
}

/// What each group is merged into, as long as that saves time; -1: nothing. Widths grow by what is merged into them.
std::vector<int> merge_into_parents(ColumnGroups& groups) {
    auto& [columns, first, last, width, below, parent] = groups;
    std::vector<int> merged_into(first.size(), -1);
    ItemLists children(first.size());
    for (int g = groups.count() - 1; g >= 0; --g)
        if (parent[g] >= 0) children.push_front(parent[g], g);
    std::vector<double> cost(first.size());
    for (int g = 0; g < groups.count(); ++g) {
        cost[g] = elimination_cost(width[g], below[g]);
        for (int child = children.head[g]; child >= 0; child = children.next[child]) {
            const double together = elimination_cost(width[g] + width[child], below[g]);
            if (together > cost[g] + cost[child]) continue;
            cost[g] = together;
            width[g] += width[child];
            merged_into[child] = g;
        }
    }
    return merged_into;
}

/// Columns of the same pattern, then merged with their parents as long as that saves time.
Supernodes merge_columns(
    const std::vector<Column>& tree, const std::vector<int>& order, const std::vector<int>& sizes) {
    ColumnGroups groups = group_columns(tree, order, sizes);
    const std::vector<int> merged_into = merge_into_parents(groups);
    const auto& [columns, first, last, width, below, parent] = groups;

    // Parents come later than their children, so that going down finds them merged already.
    ItemLists members(first.size());
    std::vector<int> keeper(first.size()), kept_parent(first.size(), kNotANode);
    for (int g = groups.count() - 1; g >= 0; --g) {
        keeper[g] = merged_into[g] < 0 ? g : keeper[merged_into[g]];
        members.push_front(keeper[g], g);
        if (keeper[g] == g) kept_parent[g] = parent[g] < 0 ? -1 : keeper[parent[g]];
    }
    const std::vector<int> kept = postorder(kept_parent);
    std::vector<int> place(first.size());
    for (std::size_t k = 0; k < kept.size(); ++k) place[kept[k]] = static_cast<int>(k);

    Supernodes supernodes;
    supernodes.order.reserve(order.size());
    for (const int g : kept) {
        for (int member = members.head[g]; member >= 0; member = members.next[member])
            for (int k = first[member]; k <= last[member]; ++k) supernodes.order.push_back(order[columns[k]]);
        supernodes.end.push_back(static_cast<int>(supernodes.order.size()));
        supernodes.parent.push_back(kept_parent[g] < 0 ? -1 : place[kept_parent[g]]);
        supernodes.width.push_back(width[g]);
        supernodes.below.push_back(below[g]);
    }
    return supernodes;
}

double elimination_cost(const Supernodes& supernodes) {
    double cost = 0.0;
    for (std::size_t g = 0; g < supernodes.end.size(); ++g)
        cost += elimination_cost(supernodes.width[g], supernodes.below[g]);
    return cost;
}

}  // namespace

BlockGraph make_block_graph(int count, const std::vector<std::pair<int, int>>& pairs) {
    BlockGraph graph;
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

std::vector<int> inverse_of(const std::vector<int>& order) {
    std::vector<int> position(order.size());
    for (std::size_t k = 0; k < order.size(); ++k) position[order[k]] = static_cast<int>(k);
    return position;
}

Supernodes find_supernodes(const BlockGraph& graph, const std::vector<int>& sizes) {
    // Not tried where it would take more than about a third of a factorization, which tends to be where it gains
    // nothing: on small, thin and loosely coupled graphs.
    constexpr double kPerNeighbor = 2000.0, kPerBlock = 8000.0;
    const std::vector<int> order = minimum_degree_order(graph);
    Supernodes supernodes = merge_columns(make_tree(graph, order, sizes), order, sizes);
    const double cost = elimination_cost(supernodes);
    if (cost <
        kPerNeighbor * static_cast<double>(graph.neighbor.size()) + kPerBlock * static_cast<double>(sizes.size()))
        return supernodes;
    const std::vector<int> dissected = nested_dissection({graph.start, graph.neighbor}, sizes, order).order;
    Supernodes other = merge_columns(make_tree(graph, dissected, sizes), dissected, sizes);
    if (elimination_cost(other) < cost) supernodes = std::move(other);
    return supernodes;
}

SupernodeRows rows_below(const BlockGraph& graph, const Supernodes& supernodes, const std::vector<int>& supernode_of) {
    const int count = static_cast<int>(supernodes.order.size());
    const std::size_t supernode_count = supernodes.end.size();
    const std::vector<int> position = inverse_of(supernodes.order);
    std::vector<int> visitor(supernode_count, -1);
    std::vector<std::pair<int, int>> found;  // supernode, row
    SupernodeRows lists;
    lists.start.assign(supernode_count + 1, 0);
    for (int i = 0; i < count; ++i) {
        const int block = supernodes.order[i];
        visitor[supernode_of[i]] = i;
        for (int k = graph.start[block]; k < graph.start[block + 1]; ++k) {
            const int column = position[graph.neighbor[k]];
            if (column > i) continue;
            for (int g = supernode_of[column]; visitor[g] != i; g = supernodes.parent[g]) {
                visitor[g] = i;
                found.emplace_back(g, i);
                ++lists.start[g + 1];
            }
        }
    }
    for (std::size_t g = 0; g < supernode_count; ++g) lists.start[g + 1] += lists.start[g];
    std::vector<int> next(lists.start.begin(), lists.start.end() - 1);
    lists.row.resize(found.size());
    for (const auto& [g, row] : found) lists.row[next[g]++] = row;
    return lists;
}

}  // namespace diffsim
