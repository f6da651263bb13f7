#include "geometry/box_tree.hpp"

#include <algorithm>
#include <numeric>

namespace diffsim {
namespace {

struct Builder {
    const std::vector<Box>& boxes;
    std::vector<Vec3> centers;
    std::vector<int> order;
    BoxTree tree;

    explicit Builder(const std::vector<Box>& item_boxes) : boxes(item_boxes), order(item_boxes.size()) {
        centers.reserve(boxes.size());
        for (const Box& box : boxes) centers.push_back(box.center());
        std::iota(order.begin(), order.end(), 0);
        tree.nodes.reserve(2 * boxes.size());
    }

    int build(int begin, int end) {
        const int node = static_cast<int>(tree.nodes.size());
        tree.nodes.emplace_back();
        if (end - begin == 1) {
            tree.nodes[node].item = order[begin];
            tree.nodes[node].box = boxes[order[begin]];
            return node;
        }
        Box spread;
        for (int k = begin; k < end; ++k) spread.include(centers[order[k]]);
        int axis;
        (spread.upper - spread.lower).maxCoeff(&axis);
        const int middle = (begin + end) / 2;
        std::nth_element(order.begin() + begin, order.begin() + middle, order.begin() + end, [&](int a, int b) {
            return centers[a][axis] != centers[b][axis] ? centers[a][axis] < centers[b][axis] : a < b;
        });
        const int left = build(begin, middle);
        const int right = build(middle, end);
        tree.nodes[node].left = left;
        tree.nodes[node].right = right;
        tree.nodes[node].box = tree.nodes[left].box;
        tree.nodes[node].box.include(tree.nodes[right].box);
        return node;
    }
};

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

}  // namespace

BoxTree build_box_tree(const std::vector<Box>& boxes) {
    if (boxes.empty()) return {};
    Builder builder(boxes);
    builder.build(0, static_cast<int>(boxes.size()));
    return std::move(builder.tree);
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
