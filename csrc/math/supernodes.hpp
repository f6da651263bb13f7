#pragma once

#include <cstddef>
#include <utility>
#include <vector>

namespace diffsim {

/// Which blocks of a symmetric matrix may be non-zero. The neighbours of block i stand at start[i] to start[i + 1] - 1,
/// and beside each the number of the pair that it comes from.
struct BlockGraph {
    std::vector<int> start, neighbor, pair;
};

/// pairs: (i < j), unique.
BlockGraph make_block_graph(int count, const std::vector<std::pair<int, int>>& pairs);

/// Columns of the factor that are eliminated together, in postorder of their elimination tree.
struct Supernodes {
    std::vector<int> order;   ///< blocks, supernode by supernode
    std::vector<int> end;     ///< where each supernode ends in `order`
    std::vector<int> parent;  ///< -1: none
    std::vector<int> width;   ///< scalar columns
    std::vector<int> below;   ///< scalar rows of the factor below these columns' own
};

/// An order of elimination with little fill and its supernodes: by minimum degree, or by nested dissection where that
/// is faster, which it mostly is from some thousand blocks on. sizes: rows of each block.
Supernodes find_supernodes(const BlockGraph& graph, const std::vector<int>& sizes);

/// The blocks below each supernode, by their places in the order, ascending: row[start[s]] to row[start[s + 1] - 1].
struct SupernodeRows {
    std::vector<int> start, row;
};

/// supernode_of: of each place in the order.
SupernodeRows rows_below(const BlockGraph& graph, const Supernodes& supernodes, const std::vector<int>& supernode_of);

/// Items of each owner: those of o are head[o], next[head[o]] and so on, until -1.
struct ItemLists {
    std::vector<int> head, next;
    explicit ItemLists(std::size_t count) : head(count, -1), next(count, -1) {}
    void push_front(int owner, int item) {
        next[item] = head[owner];
        head[owner] = item;
    }
};

/// The place of each item of an order.
std::vector<int> inverse_of(const std::vector<int>& order);

}  // namespace diffsim
