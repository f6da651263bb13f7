#include "step/object_groups.hpp"

#include <utility>
#include <vector>

#include "check.hpp"

namespace test_object_groups {

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
    std::vector<Box> swept;

    explicit Line(const std::vector<double>& places) { place(places); }

    void place(const std::vector<double>& places) {
        movers.clear();
        const int count = static_cast<int>(places.size());
        const auto object = [](int k) { return 3 * (k / 2) + k % 2; };
        for (int k = 0; k < count; ++k) movers.push_back(object(k));
        groups.start(object(count) + 1, movers);
        swept.resize(static_cast<std::size_t>(object(count)) + 1);
        for (int k = 0; k < count; ++k) swept[movers[k]] = groups.space(movers[k]) = unit_box(places[k]);
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
    Line line({0.0, 5.0, 0.5, 9.0, 1.4});  // objects 0, 1, 3, 4, 6
    line.groups.unite_overlapping();
    CHECK(line.sorted() == (Groups{{0, 3, 6}, {1}, {4}}));
    CHECK(line.groups.include_swept(line.swept).empty());
    line.groups.unite_all();
    CHECK(line.sorted() == (Groups{{0, 1, 3, 4, 6}}));
}

TEST(groups_are_joined_where_an_object_left_its_space) {
    Line line({0.0, 5.0, 0.5, 9.0});
    line.groups.unite_overlapping();
    line.swept[4] = unit_box(5.9);  // object 4, at 9, went to where object 1 is
    const std::vector<std::pair<int, int>> joined = line.groups.include_swept(line.swept);
    CHECK(joined == (std::vector<std::pair<int, int>>{{1, 4}}));
    CHECK(line.sorted() == (Groups{{0, 3}, {1, 4}}));
    CHECK(line.groups.space(4).lower.x() == 5.9);
    CHECK(line.groups.space(4).upper.x() == 10.0);
    CHECK(line.groups.include_swept(line.swept).empty());
}

TEST(groups_of_the_next_step_do_not_depend_on_the_last_one) {
    check::Random random(3);
    Line walking({});
    for (const double spread : {1.0, 1.1, 1.2, 4.0, 1.0}) {  // near the last places, and far from them
        std::vector<double> places;
        for (int k = 0; k < 300; ++k) places.push_back(spread * (2.0 * k + random.uniform(0.0, 2.0)));
        Line fresh(places);
        fresh.groups.unite_overlapping();
        walking.place(places);
        walking.groups.unite_overlapping();
        CHECK(walking.sorted() == fresh.sorted());
        CHECK(fresh.sorted().size() > 100);
    }
}

}  // namespace test_object_groups
