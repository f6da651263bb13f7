#include "step/object_groups.hpp"

#include <utility>
#include <vector>

#include "check.hpp"

using namespace diffsim;

namespace {

Box unit_box(double x) {
    Box box;
    box.include(Vec3(x, 0.0, 0.0));
    box.include(Vec3(x + 1.0, 1.0, 1.0));
    return box;
}

/// Movers at these places along a line, among objects of which every third does not yield.
struct Line {
    std::vector<int> movers;
    ObjectGroups groups;
    std::vector<Box> visited;
    Workers workers;

    Line(const std::vector<double>& places, int thread_count) : workers(thread_count) {
        const int count = static_cast<int>(places.size());
        const auto object = [](int k) { return 3 * (k / 2) + k % 2; };
        for (int k = 0; k < count; ++k) movers.push_back(object(k));
        groups.start(object(count) + 1, movers);
        visited.resize(static_cast<std::size_t>(object(count)) + 1);
        for (int k = 0; k < count; ++k) visited[movers[k]] = groups.space(movers[k]) = unit_box(places[k]);
    }

    /// The movers of each group by their places in the list.
    std::vector<std::vector<int>> sorted() {
        std::vector<std::vector<int>> result;
        for (const ObjectGroup& group : groups.sorted()) {
            CHECK(group.root == groups.members()[group.first]);
            result.emplace_back(groups.members().begin() + group.first, groups.members().begin() + group.end);
        }
        return result;
    }
};

using Groups = std::vector<std::vector<int>>;

}  // namespace

TEST(objects_whose_spaces_overlap_are_one_group) {
    Line line({0.0, 5.0, 0.5, 9.0, 1.4}, 1);  // objects 0, 1, 3, 4, 6
    line.groups.unite_overlapping(line.workers);
    CHECK(line.sorted() == (Groups{{0, 3, 6}, {1}, {4}}));
    CHECK(line.groups.include_visited(line.visited, line.workers).empty());
    line.groups.unite_all();
    CHECK(line.sorted() == (Groups{{0, 1, 3, 4, 6}}));
}

TEST(groups_are_joined_where_an_object_left_its_space) {
    Line line({0.0, 5.0, 0.5, 9.0}, 1);
    line.groups.unite_overlapping(line.workers);
    line.visited[4] = unit_box(5.9);  // object 4, at 9, went to where object 1 is
    const std::vector<std::pair<int, int>> joined = line.groups.include_visited(line.visited, line.workers);
    CHECK(joined == (std::vector<std::pair<int, int>>{{1, 4}}));
    CHECK(line.sorted() == (Groups{{0, 3}, {1, 4}}));
    CHECK(line.groups.space(4).lower.x() == 5.9);
    CHECK(line.groups.space(4).upper.x() == 10.0);
    CHECK(line.groups.include_visited(line.visited, line.workers).empty());
}

TEST(groups_of_many_objects_do_not_depend_on_the_number_of_threads) {
    check::Random random(3);
    std::vector<double> places;
    for (int k = 0; k < 700; ++k) places.push_back(random.uniform(0.0, 1200.0));
    Groups expected;
    for (const int threads : {1, 3}) {
        Line line(places, threads);
        line.groups.unite_overlapping(line.workers);
        if (threads == 1) expected = line.sorted();
        CHECK(line.sorted() == expected);
    }
    CHECK(expected.size() > 100);
    CHECK(expected.size() < 600);
}
