#pragma once

#include <utility>
#include <vector>

#include "geometry/box_tree.hpp"
#include "math/union_find.hpp"

/// Which objects are solved together, by the space that they may go through.
namespace diffsim {

/// Objects to be solved together: their places in ObjectGroups::members().
struct ObjectGroup {
    int root;  ///< the smallest of them
    int first, end;
};

/// Which of the objects that yield in a step may meet: each has a space reserved for its motion, and objects whose
/// spaces overlap are in one group, which the smallest of them stands for.
class ObjectGroups {
public:
    /// Each of the movers, ascending, in a group of its own, with no space yet.
    void start(int object_count, const std::vector<int>& movers);

    /// World frame, margins included.
    Box& space(int object) { return m_space[object]; }
    const Box& space(int object) const { return m_space[object]; }

    void unite_all();
    void unite_overlapping();

    /// Objects that were pushed out of their space may have met others: adds what they swept (of all objects) to it,
    /// and joins groups that overlap now. The joined pairs, by their roots before.
    std::vector<std::pair<int, int>> include_swept(const std::vector<Box>& swept);

    /// All groups by their roots, ascending. Valid until groups are united again.
    const std::vector<ObjectGroup>& sorted();
    /// Objects group by group, as sorted() left them, ascending within each.
    const std::vector<int>& members() const { return m_members; }

private:
    /// Pairs of places in m_movers.
    std::vector<std::pair<int, int>> overlaps();

    std::vector<int> m_movers;
    std::vector<Box> m_space;  // of each object
    UnionFind m_groups;
    std::vector<Box> m_boxes;            // of the movers, scratch of overlaps()
    BoxTree m_tree;                      // over them; kept from step to step for as long as it serves
    double m_built_extents = 0.0;        // of its inner nodes when it was built
    std::vector<int> m_members, m_next;  // sorted by group; scratch of sorted()
    std::vector<ObjectGroup> m_sorted;
};

}  // namespace diffsim
