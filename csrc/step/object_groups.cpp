#include "step/object_groups.hpp"

#include <cstddef>
#include <numeric>

namespace diffsim {
namespace {

constexpr double kWorn = 1.5;  // times the extents that it was built with: a tree is built anew

}  // namespace

void ObjectGroups::start(int object_count, const std::vector<int>& movers) {
    m_movers = movers;
    m_space.assign(static_cast<std::size_t>(object_count), Box());
    m_groups.reset(object_count);
}

void ObjectGroups::unite_all() {
    for (int i : m_movers) m_groups.unite(m_movers[0], i);
}

void ObjectGroups::unite_overlapping() {
    for (const auto& [a, b] : overlaps()) m_groups.unite(m_movers[a], m_movers[b]);
}

std::vector<std::pair<int, int>> ObjectGroups::overlaps() {
    m_boxes.clear();
    for (int i : m_movers) m_boxes.push_back(m_space[i]);
    const bool fits = !m_boxes.empty() && m_tree.nodes.size() == 2 * m_boxes.size() - 1;
    if (!fits || !(refit(m_tree, m_boxes) <= kWorn * m_built_extents)) {
        m_tree = build_box_tree(m_boxes);
        m_built_extents = refit(m_tree, m_boxes);
    }
    return overlapping_pairs(m_tree);
}

std::vector<std::pair<int, int>> ObjectGroups::include_swept(const std::vector<Box>& swept) {
    bool left = false;
    for (int i : m_movers) {
        left = left || (swept[i].lower.array() < m_space[i].lower.array()).any() ||
               (swept[i].upper.array() > m_space[i].upper.array()).any();
    }
    std::vector<std::pair<int, int>> joined;
    if (!left) return joined;
    for (int i : m_movers) m_space[i].include(swept[i]);
    for (const auto& [a, b] : overlaps()) {
        const int i = m_groups.find(m_movers[a]), j = m_groups.find(m_movers[b]);
        if (i == j) continue;
        m_groups.unite(i, j);
        joined.emplace_back(i, j);
    }
    return joined;
}

const std::vector<ObjectGroup>& ObjectGroups::sorted() {
    // Counting sort.
    const std::size_t object_count = m_space.size();
    m_next.assign(object_count + 1, 0);
    for (int i : m_movers) ++m_next[static_cast<std::size_t>(m_groups.find(i)) + 1];
    std::partial_sum(m_next.begin(), m_next.end(), m_next.begin());
    m_members.resize(m_movers.size());
    for (int i : m_movers) m_members[m_next[m_groups.find(i)]++] = i;
    m_sorted.clear();
    int first = 0;
    for (std::size_t root = 0; root < object_count; ++root) {
        const int end = m_next[root];
        if (first < end) m_sorted.push_back({static_cast<int>(root), first, end});
        first = end;
    }
    return m_sorted;
}

}  // namespace diffsim
