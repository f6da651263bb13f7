#include "math/supernodes.hpp"

#include <algorithm>
#include <set>
#include <utility>
#include <vector>

#include "check.hpp"

namespace test_supernodes {

using namespace diffsim;
using Pairs = std::vector<std::pair<int, int>>;

namespace {

/// The places below the diagonal where the columns of the factor are not zero, by eliminating them one after the other.
std::vector<std::set<int>> eliminate(int count, const Pairs& pairs, const std::vector<int>& place) {
    std::vector<std::set<int>> columns(static_cast<std::size_t>(count));
    for (const auto& [i, j] : pairs) columns[std::min(place[i], place[j])].insert(std::max(place[i], place[j]));
    for (const std::set<int>& column : columns) {
        if (column.empty()) continue;
        std::set<int>& parent = columns[*column.begin()];
        parent.insert(std::next(column.begin()), column.end());
    }
    return columns;
}

Pairs grid(int side) {
    Pairs pairs;
    for (int row = 0; row < side; ++row) {
        for (int column = 0; column < side; ++column) {
            const int i = row * side + column;
            if (column + 1 < side) pairs.emplace_back(i, i + 1);
            if (row + 1 < side) pairs.emplace_back(i, i + side);
        }
    }
    return pairs;
}

Pairs scattered(int count, double density, check::Random& random) {
    Pairs pairs;
    for (int i = 0; i < count; ++i)
        for (int j = i + 1; j < count; ++j)
            if (random.uniform(0.0, 1.0) < density) pairs.emplace_back(i, j);
    return pairs;
}

void check_supernodes(int count, const Pairs& pairs) {
    std::vector<int> sizes;
    for (int i = 0; i < count; ++i) sizes.push_back(i % 3 == 0 ? 6 : 3);
    const BlockGraph graph = make_block_graph(count, pairs);
    const Supernodes supernodes = find_supernodes(graph, sizes);
    const std::vector<int> place = inverse_of(supernodes.order);
    const std::vector<std::set<int>> columns = eliminate(count, pairs, place);

    std::vector<int> supernode_of;
    for (int s = 0; s < static_cast<int>(supernodes.end.size()); ++s)
        while (static_cast<int>(supernode_of.size()) < supernodes.end[s]) supernode_of.push_back(s);
    CHECK(static_cast<int>(supernode_of.size()) == count);
    const SupernodeRows rows = rows_below(graph, supernodes, supernode_of);

    int begin = 0;
    for (int s = 0; s < static_cast<int>(supernodes.end.size()); ++s) {
        NOTE(s);
        const int end = supernodes.end[s];
        std::set<int> expected;
        int width = 0, below = 0;
        for (int k = begin; k < end; ++k) {
            expected.insert(columns[k].lower_bound(end), columns[k].end());
            width += sizes[supernodes.order[k]];
        }
        for (const int k : expected) below += sizes[supernodes.order[k]];
        const std::vector<int> found(rows.row.begin() + rows.start[s], rows.row.begin() + rows.start[s + 1]);
        CHECK(found == std::vector<int>(expected.begin(), expected.end()));
        CHECK(supernodes.width[s] == width);
        CHECK(supernodes.below[s] == below);
        CHECK(supernodes.parent[s] == (expected.empty() ? -1 : supernode_of[*expected.begin()]));
        begin = end;
    }
}

}  // namespace

TEST(supernodes_have_the_rows_that_elimination_fills) {
    check::Random random(5);
    check_supernodes(1, {});
    check_supernodes(7, {});
    check_supernodes(8, scattered(8, 1.0, random));
    for (const double density : {0.02, 0.1, 0.3}) {
        NOTE(density);
        check_supernodes(60, scattered(60, density, random));
    }
    check_supernodes(49, grid(7));
}

TEST(supernodes_of_large_grids_have_them_too) {
    check_supernodes(48 * 48, grid(48));
    check_supernodes(70 * 70, grid(70));
}

}  // namespace test_supernodes
