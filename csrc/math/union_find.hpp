#pragma once

#include <algorithm>
#include <numeric>
#include <vector>

namespace diffsim {

/// Disjoint sets; the root of a set is its smallest member, so that numbering does not depend on the order of unions.
class UnionFind {
public:
    void reset(int count) {
        m_parent.resize(static_cast<std::size_t>(count));
        std::iota(m_parent.begin(), m_parent.end(), 0);
    }
    int find(int i) {
        while (m_parent[i] != i) i = m_parent[i] = m_parent[m_parent[i]];
        return i;
    }
    void unite(int i, int j) {
        i = find(i);
        j = find(j);
        m_parent[std::max(i, j)] = std::min(i, j);
    }

private:
    std::vector<int> m_parent;
};

}  // namespace diffsim
