#pragma once

#include <vector>

namespace diffsim {

/// The neighbours of each vertex of an undirected graph, without itself: those of v are vertex[start[v]] to
/// vertex[start[v + 1] - 1].
struct Neighbors {
    const std::vector<int>& start;
    const std::vector<int>& vertex;
};

/// Places of an order: no vertex of the first part [begin, second) has a neighbour in the second one, [second,
/// separator). The separator [separator, end) comes after both.
struct Cut {
    int begin, second, separator, end;
};

struct Dissection {
    std::vector<int> order;  ///< the vertex at each place
    std::vector<Cut> cuts;   ///< those of a part come after that of the whole
};

/// An order of elimination with little fill for large graphs: few vertices that separate the rest into parts of like
/// weight come last, and each part is ordered in the same way, down to parts of some ten vertices. Those, and the
/// separators, keep the given order. On planar grids of n vertices it leaves fill O(n log n), O(n^1.5) operations
/// [george1973nested, lipton1979generalized].
///
/// A separator is found from distances in the graph, and improved by moving single vertices. Nothing is random: the
/// result follows from the arguments.
///
/// weights: of the vertices, positive. order: all vertices, in a good order for small parts, say by minimum degree.
Dissection nested_dissection(
    const Neighbors& neighbors, const std::vector<int>& weights, const std::vector<int>& order);

}  // namespace diffsim
