#include "geometry/box_tree.hpp"

#include <algorithm>
#include <numeric>

namespace diffsim {
namespace {

void collect_overlaps(const BoxTree& tree, int a, int b, std::vector<std::pair<int, int>>& pairs) {
    const BoxTree::Node& na = tree.nodes[a];
    const BoxTree::Node& nb = tree.nodes[b];
    if (a == b) {
        if (na.is_leaf()) return;
        collect_overlaps(tree, na.left, na.left, pairs);
        collect_overlaps(tree, na.right, na.right, pairs);
        collect_overlaps(tree, na.left, na.right, pairs);
        return;
    }
    if (!na.box.overlaps(nb.box)) return;
    if (na.is_leaf() && nb.is_leaf()) {
        pairs.emplace_back(std::min(na.item, nb.item), std::max(na.item, nb.item));
    } else if (
        nb.is_leaf() || (!na.is_leaf() && (na.box.upper - na.box.lower).sum() >= (nb.box.upper - nb.box.lower).sum())) {
        collect_overlaps(tree, na.left, b, pairs);
        collect_overlaps(tree, na.right, b, pairs);
    } else {
        collect_overlaps(tree, a, nb.left, pairs);
        collect_overlaps(tree, a, nb.right, pairs);
    }
}

/// Orders the nodes; boxes come after.
class BoxTreeBuilder {
public:
    explicit BoxTreeBuilder(const std::vector<Box>& boxes) : m_order(boxes.size()) {
        m_centers.reserve(boxes.size());
        for (const Box& box : boxes) m_centers.push_back(box.center());
        std::iota(m_order.begin(), m_order.end(), 0);
        m_tree.nodes.resize(2 * boxes.size() - 1);
        build(0, 0, static_cast<int>(boxes.size()));
    }
    BoxTree& tree() { return m_tree; }

private:
    /// A node over these places of m_order.
    void build(int index, int begin, int end) {
        BoxTree::Node& node = m_tree.nodes[index];
        if (end - begin == 1) {
            node.item = m_order[begin];
            return;
        }
        split(begin, end);
        const int middle = (begin + end) / 2;
        // Children follow their parent, all on the left before those on the right.
        node.left = index + 1;
        node.right = index + 2 * (middle - begin);
        build(node.left, begin, middle);
        build(node.right, middle, end);
    }

    /// Sort the items into those of the left child and those of the right.
    void split(int begin, int end) {
        const auto order = m_order.begin();
        Box spread;
        for (int k = begin; k < end; ++k) spread.include(m_centers[m_order[k]]);
        int axis;
        (spread.upper - spread.lower).maxCoeff(&axis);
        std::nth_element(order + begin, order + (begin + end) / 2, order + end, [&](int a, int b) {
            return m_centers[a][axis] != m_centers[b][axis] ? m_centers[a][axis] < m_centers[b][axis] : a < b;
        });
    }

    std::vector<Vec3> m_centers;
    std::vector<int> m_order;
    BoxTree m_tree;
};

}  // namespace

BoxTree build_box_tree(const std::vector<Box>& boxes) {
    if (boxes.empty()) return {};
    BoxTreeBuilder builder(boxes);
    refit(builder.tree(), boxes);
    return std::move(builder.tree());
}

double refit(BoxTree& tree, const std::vector<Box>& boxes) {
    double extents = 0.0;
    for (std::size_t k = tree.nodes.size(); k-- > 0;) {  // children follow their parents
        BoxTree::Node& node = tree.nodes[k];
        if (node.is_leaf()) {
            node.box = boxes[node.item];
            continue;
        }
        node.box = tree.nodes[node.left].box;
        node.box.include(tree.nodes[node.right].box);
        extents += (node.box.upper - node.box.lower).sum();
    }
    return extents;
}

std::vector<std::pair<int, int>> overlapping_pairs(const BoxTree& tree) {
    std::vector<std::pair<int, int>> pairs;
    if (!tree.empty()) collect_overlaps(tree, 0, 0, pairs);
    std::sort(pairs.begin(), pairs.end());
    return pairs;
}

void query(const BoxTree& tree, const Box& box, std::vector<int>& items) {
    if (tree.empty()) return;
    std::vector<int> stack = {0};
    while (!stack.empty()) {
        const BoxTree::Node& node = tree.nodes[stack.back()];
        stack.pop_back();
        if (!node.box.overlaps(box)) continue;
        if (node.is_leaf()) {
            items.push_back(node.item);
        } else {
            stack.push_back(node.right);
            stack.push_back(node.left);
        }
    }
}

std::vector<std::pair<int, int>> overlapping_pairs(const std::vector<Box>& boxes) {
    std::vector<std::pair<int, int>> pairs;
    std::vector<int> order(boxes.size());
    std::iota(order.begin(), order.end(), 0);
    std::sort(order.begin(), order.end(), [&](int a, int b) {
        return boxes[a].lower[0] != boxes[b].lower[0] ? boxes[a].lower[0] < boxes[b].lower[0] : a < b;
    });
    for (std::size_t k = 0; k < order.size(); ++k) {
        for (std::size_t l = k + 1; l < order.size(); ++l) {
            if (boxes[order[l]].lower[0] > boxes[order[k]].upper[0]) break;
            if (boxes[order[k]].overlaps(boxes[order[l]]))
                pairs.emplace_back(std::min(order[k], order[l]), std::max(order[k], order[l]));
        }
    }
    std::sort(pairs.begin(), pairs.end());
    return pairs;
}

}  // namespace diffsim
