#pragma once

#include <utility>
#include <vector>

#include "geometry/box.hpp"

namespace diffsim {

/// Binary tree of boxes over a list of items; node 0 is the root, children follow their parent.
struct BoxTree {
    struct Node {
        Box box;
        int left = -1, right = -1;  ///< -1 in a leaf
        int item = -1;              ///< -1 in an inner node

        bool is_leaf() const { return item >= 0; }
    };
    std::vector<Node> nodes;

    bool empty() const { return nodes.empty(); }
};

/// Median split on the longest side of the box around the items' centres. Depends on the boxes alone.
BoxTree build_box_tree(const std::vector<Box>& boxes);

/// Give the tree's items these boxes. Returns the sum of the extents of its inner nodes: what searching it costs grows
/// with it when items move apart that the tree was built to keep together.
double refit(BoxTree& tree, const std::vector<Box>& boxes);

/// Pairs (i < j) of items whose boxes overlap, sorted.
std::vector<std::pair<int, int>> overlapping_pairs(const BoxTree& tree);

/// Append the items whose boxes overlap this one.
void query(const BoxTree& tree, const Box& box, std::vector<int>& items);

/// Pairs (i < j) of overlapping boxes, sorted, found by sorting along one axis: for short lists.
std::vector<std::pair<int, int>> overlapping_pairs(const std::vector<Box>& boxes);

}  // namespace diffsim
