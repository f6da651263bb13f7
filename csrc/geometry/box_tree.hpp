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

/// Builds the same tree in parts, which different threads may build at the same time.
class BoxTreeBuilder {
public:
    /// Splits the items into 2^levels parts, or fewer where they are too few. `boxes` must outlive it.
    BoxTreeBuilder(const std::vector<Box>& boxes, int levels);

    int part_count() const { return static_cast<int>(m_parts.size()); }
    void build_part(int part);
    /// The tree, once all parts are built.
    BoxTree finish();

private:
    /// A node and the items below it, by their places in m_order.
    struct Part {
        int node, begin, end;
        int middle() const { return (begin + end) / 2; }
        // Children follow their parent, all on the left before those on the right.
        Part left() const { return {node + 1, begin, middle()}; }
        Part right() const { return {node + 2 * (middle() - begin), middle(), end}; }
    };
    void split(const Part& part);
    void build(const Part& part);
    void join(const Part& part);

    const std::vector<Box>& m_boxes;
    std::vector<Vec3> m_centers;
    std::vector<int> m_order;
    std::vector<Part> m_top, m_parts;  ///< the nodes above the parts, parents first
    BoxTree m_tree;
};

/// Pairs (i < j) of items whose boxes overlap, sorted.
std::vector<std::pair<int, int>> overlapping_pairs(const BoxTree& tree);

/// Append the items whose boxes overlap this one.
void query(const BoxTree& tree, const Box& box, std::vector<int>& items);

/// Pairs (i < j) of overlapping boxes, sorted, found by sorting along one axis: for short lists.
std::vector<std::pair<int, int>> overlapping_pairs(const std::vector<Box>& boxes);

}  // namespace diffsim
