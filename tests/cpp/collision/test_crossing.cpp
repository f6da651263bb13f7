#include "collision/candidates.hpp"
#include "sweep_fixtures.hpp"

namespace test_crossing {

using namespace diffsim;
using fixtures::DeformingSweep;
using fixtures::random_rotation;
using fixtures::random_sheet;
using fixtures::random_vec3;
using fixtures::segment;
using fixtures::TriangleMesh;

namespace {

/// Whether two boxes overlap: no axis among face normals and cross products of edges separates them.
bool boxes_overlap(const Vec3& half_a, const Pose& a, const Vec3& half_b, const Pose& b) {
    std::vector<Vec3> axes;
    for (int i = 0; i < 3; ++i) {
        axes.push_back(a.R.col(i));
        axes.push_back(b.R.col(i));
        for (int j = 0; j < 3; ++j) axes.push_back(a.R.col(i).cross(b.R.col(j)));
    }
    return std::none_of(axes.begin(), axes.end(), [&](const Vec3& axis) {
        const double reach =
            (a.R.transpose() * axis).cwiseAbs().dot(half_a) + (b.R.transpose() * axis).cwiseAbs().dot(half_b);
        return std::abs(axis.dot(a.t - b.t)) > reach + 1e-12;
    });
}

bool meshes_cross_at(const CollisionMesh& a, const Pose& pose_a, const CollisionMesh& b, const Pose& pose_b) {
    return meshes_cross({&a, {pose_a, pose_a}, 0.0}, {&b, {pose_b, pose_b}, 0.0});
}

/// Whether an edge of one sheet goes through a triangle of the other, by the signs of volumes. Of one sheet (a == b),
/// edges that end at the triangle do not.
bool sheets_cross(const Cloth& a, const std::vector<Vec3>& xa, const Cloth& b, const std::vector<Vec3>& xb) {
    const auto volume = [](const Vec3& p, const Vec3& q, const Vec3& r, const Vec3& s) {
        return (q - p).dot((r - p).cross(s - p));
    };
    for (const Edge& edge : a.surface.edges)
        for (const ClothTriangle& triangle : b.triangles) {
            const auto [i, j, k] = triangle.nodes;
            if (&a == &b &&
                (edge.p0 == i || edge.p0 == j || edge.p0 == k || edge.p1 == i || edge.p1 == j || edge.p1 == k))
                continue;
            const Vec3 &p = xa[edge.p0], &q = xa[edge.p1];
            if (volume(p, xb[i], xb[j], xb[k]) * volume(q, xb[i], xb[j], xb[k]) >= 0.0) continue;
            const double v0 = volume(p, q, xb[i], xb[j]), v1 = volume(p, q, xb[j], xb[k]),
                         v2 = volume(p, q, xb[k], xb[i]);
            if ((v0 > 0.0) == (v1 > 0.0) && (v1 > 0.0) == (v2 > 0.0)) return true;
        }
    return false;
}

}  // namespace

TEST(meshes_cross_where_boxes_overlap) {
    check::Random random(7);
    const Vec3 half_a(0.5, 0.4, 0.3), half_b(0.6, 0.5, 0.2);
    const CollisionMesh mesh_a = fixtures::collision_mesh(fixtures::box(half_a));
    const CollisionMesh mesh_b = fixtures::collision_mesh(fixtures::box(half_b));
    int crossing = 0, apart = 0;
    for (int k = 0; k < 500; ++k) {
        NOTE(k);
        const Pose a{random_rotation(random), random_vec3(random, 0.7)};
        const Pose b{random_rotation(random), random_vec3(random, 0.7)};
        const bool overlap = boxes_overlap(half_a, a, half_b, b);  // neither fits into the other
        CHECK(meshes_cross_at(mesh_a, a, mesh_b, b) == overlap);
        CHECK(meshes_cross_at(mesh_b, b, mesh_a, a) == overlap);
        (overlap ? crossing : apart) += 1;
    }
    CHECK(crossing >= 50);
    CHECK(apart >= 50);
}

TEST(a_mesh_inside_another_does_not_cross_it) {
    const CollisionMesh large = fixtures::collision_mesh(fixtures::box(Vec3(1.0, 1.0, 1.0)));
    const CollisionMesh small = fixtures::collision_mesh(fixtures::box(Vec3(0.1, 0.1, 0.1)));
    CHECK(!meshes_cross_at(large, Pose{}, small, Pose{}));
    CHECK(meshes_cross_at(large, Pose{}, small, Pose{Mat3::Identity(), Vec3(1.0, 0.2, 0.3)}));
}

TEST(a_segment_crosses_the_face_that_it_goes_through) {
    const CollisionMesh cube = fixtures::collision_mesh(fixtures::box(Vec3(1, 1, 1))), rod = segment();
    CHECK(meshes_cross_at(cube, Pose{}, rod, Pose{Mat3::Identity(), Vec3(1.0, 0.2, 0.3)}));
    CHECK(meshes_cross_at(rod, Pose{Mat3::Identity(), Vec3(1.0, 0.2, 0.3)}, cube, Pose{}));
    CHECK(!meshes_cross_at(cube, Pose{}, rod, Pose{Mat3::Identity(), Vec3(2.1, 0.2, 0.3)}));
    CHECK(!meshes_cross_at(cube, Pose{}, rod, Pose{Mat3::Identity(), Vec3(1.0, 0.2, 1.1)}));
    CHECK(!meshes_cross_at(rod, Pose{}, rod, Pose{exp_rotation(Vec3(0, 0, 1)), Vec3::Zero()}));
}

TEST(sheets_cross_where_an_edge_goes_through_a_triangle) {
    const Cloth first = fixtures::cloth(fixtures::grid(6, 3, 0.2)), second = fixtures::cloth(fixtures::hexagon(0.5));
    const TriangleMesh shape = fixtures::hexagon(0.5);
    const CollisionMesh rigid = build_collision_mesh(shape.vertices, shape.triangles, Faces::separate);
    check::Random random(14);
    int crossing = 0, apart = 0;
    for (int k = 0; k < 150; ++k) {
        NOTE(k);
        DeformingSweep a = random_sheet(first, random, 0.5, 0.0), b = random_sheet(second, random, 0.5, 0.0);
        const Pose pose{random_rotation(random), random_vec3(random, 0.6)};
        b.begin = fixtures::moved(second.rest, pose.R, pose.t);
        const bool expected =
            sheets_cross(first, a.begin, second, b.begin) || sheets_cross(second, b.begin, first, a.begin);
        CHECK(meshes_cross(a.swept(), b.swept()) == expected);
        CHECK(meshes_cross(a.swept(), {&rigid, {pose, pose}, 0.0}) == expected);
        (expected ? crossing : apart) += 1;
    }
    CHECK(crossing >= 20);
    CHECK(apart >= 20);
}

TEST(a_sheet_crosses_itself_where_an_edge_goes_through_a_triangle) {
    const Cloth sheet = fixtures::cloth(fixtures::grid(8, 2, 0.2)), pair = fixtures::cloth(fixtures::folded_pair(0.4));
    check::Random random(15);
    int crossing = 0, apart = 0;
    for (int k = 0; k < 150; ++k) {
        NOTE(k);
        DeformingSweep swept = random_sheet(sheet, random, 0.0, 0.0);
        swept.begin = fixtures::shaken(fixtures::rolled(sheet.rest, 0.15, 0.1), random, random.uniform(0.0, 0.15));
        const bool expected = sheets_cross(sheet, swept.begin, sheet, swept.begin);
        CHECK(crosses_itself(swept.swept()) == expected);
        (expected ? crossing : apart) += 1;
    }
    CHECK(crossing >= 20);
    CHECK(apart >= 20);
    // Two triangles with a common side cannot.
    for (const double angle : {0.0, 0.4, 3.1, -3.1}) {
        DeformingSweep swept{&pair.surface, fixtures::folded_pair(angle).vertices, {}, 0.0};
        swept.end = swept.begin;
        CHECK(!crosses_itself(swept.swept()));
    }
}

TEST(triangles_with_one_common_node_can_cross) {
    const TriangleMesh mesh{{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {-1, 0, 0}, {-1, -1, 0}}, {{0, 1, 2}, {0, 3, 4}}};
    const Cloth cloth = fixtures::cloth(mesh);
    DeformingSweep swept{&cloth.surface, mesh.vertices, mesh.vertices, 0.0};
    CHECK(!crosses_itself(swept.swept()));
    swept.begin[3] = Vec3(0.5, 0.25, 0.3);
    swept.begin[4] = Vec3(0.5, 0.25, -0.3);
    CHECK(crosses_itself(swept.swept()));
}

}  // namespace test_crossing
