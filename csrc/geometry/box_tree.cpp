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

}  // namespace

BoxTreeBuilder::BoxTreeBuilder(const std::vector<Box>& boxes, int levels) : m_boxes(boxes), m_order(boxes.size()) {
    if (boxes.empty()) return;
    m_centers.reserve(boxes.size());
    for (const Box& box : boxes) m_centers.push_back(box.center());
    std::iota(m_order.begin(), m_order.end(), 0);
    m_tree.nodes.resize(2 * boxes.size() - 1);
    m_parts.push_back({0, 0, static_cast<int>(boxes.size())});
    for (int level = 0; level < levels; ++level) {
        std::vector<Part> parts;
        for (const Part& part : m_parts) {
            if (part.end - part.begin == 1) {
                parts.push_back(part);
                continue;
            }
            split(part);
            m_top.push_back(part);
            parts.push_back(part.left());
            parts.push_back(part.right());
        }
        m_parts = std::move(parts);
    }
}

void BoxTreeBuilder::build_part(int part) { build(m_parts[static_cast<std::size_t>(part)]); }

BoxTree BoxTreeBuilder::finish() {
    for (std::size_t k = m_top.size(); k-- > 0;) join(m_top[k]);
    return std::move(m_tree);
}

/// Sort the items into those of the left child and those of the right.
void BoxTreeBuilder::split(const Part& part) {
    const auto order = m_order.begin();
    Box spread;
    for (int k = part.begin; k < part.end; ++k) spread.include(m_centers[m_order[k]]);
    int axis;
    (spread.upper - spread.lower).maxCoeff(&axis);
    std::nth_element(order + part.begin, order + part.middle(), order + part.end, [&](int a, int b) {
        return m_centers[a][axis] != m_centers[b][axis] ? m_centers[a][axis] < m_centers[b][axis] : a < b;
    });
}

void BoxTreeBuilder::build(const Part& part) {
    if (part.end - part.begin == 1) {
        BoxTree::Node& leaf = m_tree.nodes[part.node];
        leaf.item = m_order[part.begin];
        leaf.box = m_boxes[leaf.item];
        return;
    }
    split(part);
    build(part.left());
    build(part.right());
    join(part);
}

void BoxTreeBuilder::join(const Part& part) {
    BoxTree::Node& node = m_tree.nodes[part.node];
    node.left = part.left().node;
    node.right = part.right().node;
    node.box = m_tree.nodes[node.left].box;
    node.box.include(m_tree.nodes[node.right].box);
}

BoxTree build_box_tree(const std::vector<Box>& boxes) {
    BoxTreeBuilder builder(boxes, 0);
    for (int part = 0; part < builder.part_count(); ++part) builder.build_part(part);
    return builder.finish();
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
