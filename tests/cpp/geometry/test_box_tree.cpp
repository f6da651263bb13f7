#include "geometry/box_tree.hpp"

#include <algorithm>

#include "fixtures.hpp"

namespace test_box_tree {

using namespace diffsim;
using Pairs = std::vector<std::pair<int, int>>;

namespace {

/// Random boxes on a coarse grid, so that many only touch and some coincide or have no volume.
std::vector<Box> random_boxes(check::Random& random, int count, double spread) {
    std::vector<Box> boxes;
    for (int k = 0; k < count; ++k) {
        const Vec3 lower = (spread * random.vector(3)).array().round() * 0.25;
        const Vec3 size = random.vector(3, 0.0, 4.0).array().floor() * 0.25;
        boxes.push_back({lower, lower + size});
    }
    return boxes;
}

Pairs brute_force(const std::vector<Box>& boxes) {
    Pairs pairs;
    for (int i = 0; i < static_cast<int>(boxes.size()); ++i)
        for (int j = i + 1; j < static_cast<int>(boxes.size()); ++j) {
            const Vec3 gap = (boxes[i].lower - boxes[j].upper).cwiseMax(boxes[j].lower - boxes[i].upper);
            if (gap.maxCoeff() <= 0.0) pairs.emplace_back(i, j);  // touching counts
        }
    return pairs;
}

}  // namespace

TEST(tree_and_sweep_find_the_pairs_of_brute_force) {
    check::Random random(1);
    std::size_t cases_hit = 0;
    for (const int count : {1, 2, 3, 7, 50, 200}) {
        for (const double spread : {1.0, 5.0, 20.0}) {
            NOTE(count);
            NOTE(spread);
            const std::vector<Box> boxes = random_boxes(random, count, spread);
            const Pairs expected = brute_force(boxes);
            CHECK(overlapping_pairs(build_box_tree(boxes)) == expected);
            CHECK(overlapping_pairs(boxes) == expected);
            cases_hit += expected.size();
        }
    }
    CHECK(cases_hit >= 1000);
}

TEST(query_finds_what_brute_force_finds) {
    check::Random random(2);
    std::size_t cases_hit = 0;
    const std::vector<Box> boxes = random_boxes(random, 150, 4.0);
    const BoxTree tree = build_box_tree(boxes);
    for (const Box& box : random_boxes(random, 100, 6.0)) {
        std::vector<int> expected, found = {-7};  // results are appended
        for (int i = 0; i < static_cast<int>(boxes.size()); ++i)
            if (boxes[i].overlaps(box)) expected.push_back(i);
        query(tree, box, found);
        CHECK(found[0] == -7);
        found.erase(found.begin());
        std::sort(found.begin(), found.end());
        CHECK(found == expected);
        cases_hit += expected.size();
    }
    CHECK(cases_hit >= 200);
}

TEST(tree_holds_every_item_once_inside_its_ancestors) {
    check::Random random(3);
    const std::vector<Box> boxes = random_boxes(random, 64, 5.0);
    const BoxTree tree = build_box_tree(boxes);
    CHECK(tree.nodes.size() == 2 * boxes.size() - 1);
    std::vector<int> seen(boxes.size(), 0);
    for (std::size_t k = 0; k < tree.nodes.size(); ++k) {
        const BoxTree::Node& node = tree.nodes[k];
        if (node.is_leaf()) {
            ++seen[node.item];
            CHECK(node.box.lower == boxes[node.item].lower);
            CHECK(node.box.upper == boxes[node.item].upper);
            continue;
        }
        for (const int child : {node.left, node.right}) {
            CHECK(child > static_cast<int>(k));
            CHECK((tree.nodes[child].box.lower.array() >= node.box.lower.array()).all());
            CHECK((tree.nodes[child].box.upper.array() <= node.box.upper.array()).all());
        }
    }
    for (const int times : seen) CHECK(times == 1);
}

TEST(tree_of_items_that_moved_finds_the_pairs_of_brute_force) {
    check::Random random(4);
    std::size_t cases_hit = 0;
    for (const int count : {1, 2, 3, 64, 101}) {
        NOTE(count);
        const std::vector<Box> boxes = random_boxes(random, count, 5.0), moved = random_boxes(random, count, 5.0);
        BoxTree tree = build_box_tree(boxes);
        const double before = refit(tree, boxes);
        CHECK(overlapping_pairs(tree) == brute_force(boxes));
        const double after = refit(tree, moved);
        CHECK(overlapping_pairs(tree) == brute_force(moved));
        if (count > 3) CHECK(after > 1.2 * before);  // it was built to keep others together
        cases_hit += brute_force(moved).size();
    }
    CHECK(cases_hit >= 100);
}

TEST(no_boxes_have_no_pairs) {
    const BoxTree tree = build_box_tree({});
    CHECK(tree.empty());
    CHECK(overlapping_pairs(tree).empty());
    CHECK(overlapping_pairs(std::vector<Box>()).empty());
    std::vector<int> items;
    query(tree, {Vec3::Constant(-1.0), Vec3::Constant(1.0)}, items);
    CHECK(items.empty());
}

TEST(box_of_a_turned_box_contains_its_corners_tightly) {
    check::Random random(4);
    for (int k = 0; k < 50; ++k) {
        Box box;
        box.include(fixtures::random_vec3(random));
        box.include(fixtures::random_vec3(random));
        const Pose pose{fixtures::random_rotation(random), fixtures::random_vec3(random)};
        Box expected;
        for (int corner = 0; corner < 8; ++corner) {
            Vec3 x = box.lower;
            for (int axis = 0; axis < 3; ++axis)
                if (corner >> axis & 1) x[axis] = box.upper[axis];
            expected.include(pose * x);
        }
        const Box found = transformed(box, pose);
        CHECK_NEAR(found.lower, expected.lower, 1e-14);
        CHECK_NEAR(found.upper, expected.upper, 1e-14);
    }
}

}  // namespace test_box_tree
