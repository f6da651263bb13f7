#include "model/cloth.hpp"

#include <algorithm>
#include <numeric>
#include <stdexcept>

#include "cloth_fixtures.hpp"

namespace test_cloth {

using namespace diffsim;
using fixtures::kPi;
using fixtures::TriangleMesh;

namespace {

constexpr double kRounding = 1e-13;  // of lengths and areas of order 1

Cloth build(const TriangleMesh& mesh, const Vec3& warp = Vec3::UnitX()) {
    return build_cloth(mesh.vertices, mesh.triangles, warp);
}

/// Images of warp and weft at rest, as columns.
Eigen::Matrix<double, 3, 2> material_axes(const Cloth& cloth, const ClothTriangle& triangle) {
    Eigen::Matrix<double, 3, 2> edges;
    for (int k = 0; k < 2; ++k) edges.col(k) = cloth.rest[triangle.nodes[k + 1]] - cloth.rest[triangle.nodes[0]];
    return edges * triangle.rest_inverse;
}

/// A strip of `count` squares closed to a ring after half a twist; every edge has the same sense in both of its
/// triangles somewhere.
TriangleMesh moebius_strip(int count) {
    TriangleMesh mesh;
    for (int k = 0; k < count; ++k) {
        const double angle = 2.0 * kPi * k / count;
        const Vec3 radial(std::cos(angle), std::sin(angle), 0.0);
        const Vec3 across = 0.3 * (std::cos(0.5 * angle) * radial + std::sin(0.5 * angle) * Vec3::UnitZ());
        mesh.vertices.push_back(radial + across);
        mesh.vertices.push_back(radial - across);
    }
    for (int k = 0; k < count; ++k) {
        const bool last = k + 1 == count;
        const int a = 2 * k, b = 2 * k + 1, c = last ? 1 : 2 * k + 2, d = last ? 0 : 2 * k + 3;
        mesh.triangles.emplace_back(a, b, d);
        mesh.triangles.emplace_back(a, d, c);
    }
    return mesh;
}

}  // namespace

TEST(a_grid_knows_its_areas_and_hinges) {
    const Cloth cloth = build(fixtures::grid(4, 3, 0.5));
    CHECK(cloth.node_count() == 20);
    CHECK(cloth.pinned == std::vector<char>(20, 0));
    CHECK(cloth.triangles.size() == 24);
    for (const ClothTriangle& triangle : cloth.triangles) CHECK_NEAR(triangle.area, 0.125, kRounding);
    CHECK_NEAR(cloth.node_area[0], 2.0 * 0.125 / 3.0, kRounding);  // two triangles at the diagonal's corner,
    CHECK_NEAR(cloth.node_area[4], 0.125 / 3.0, kRounding);        // one at the next, six inside
    CHECK_NEAR(cloth.node_area[6], 0.25, kRounding);
    CHECK_NEAR(std::accumulate(cloth.node_area.begin(), cloth.node_area.end(), 0.0), 3.0, kRounding);

    CHECK(cloth.hinges.size() == 3 * 3 + 4 * 2 + 12);  // across x, across y, diagonals
    int diagonals = 0;
    for (const ClothHinge& hinge : cloth.hinges) {
        const bool diagonal = hinge.nodes[1] - hinge.nodes[0] == 6;
        CHECK(hinge.nodes[0] < hinge.nodes[1]);
        CHECK(hinge.rest_angle == 0.0);
        CHECK(hinge.weight > 0.0);
        diagonals += diagonal ? 1 : 0;
    }
    CHECK(diagonals == 12);
}

TEST(the_surface_keeps_every_triangle_and_edge) {
    const TriangleMesh mesh = fixtures::grid(4, 3, 0.5);
    const Cloth cloth = build(mesh);
    CHECK(cloth.surface.patches.size() == mesh.triangles.size());
    CHECK(cloth.surface.edges.size() == cloth.hinges.size() + 14);  // and the rim
    CHECK(cloth.surface.active_vertices.size() == mesh.vertices.size());
}

TEST(material_axes_are_the_warp_in_the_plane_and_across) {
    check::Random random(1);
    const Vec3 warp(0.3, 2.0, -0.4);
    int cases_hit = 0;
    TriangleMesh mesh = fixtures::grid(5, 5, 0.2);
    mesh.vertices = fixtures::shaken(mesh.vertices, random, 0.08);
    const Cloth cloth = build(mesh, warp);
    for (const ClothTriangle& triangle : cloth.triangles) {
        const Eigen::Matrix<double, 3, 2> axes = material_axes(cloth, triangle);
        CHECK_NEAR(axes.transpose() * axes, Eigen::Matrix2d::Identity(), kRounding);
        const Vec3 edge1 = cloth.rest[triangle.nodes[1]] - cloth.rest[triangle.nodes[0]];
        const Vec3 edge2 = cloth.rest[triangle.nodes[2]] - cloth.rest[triangle.nodes[0]];
        const Vec3 normal = edge1.cross(edge2).normalized(), u = axes.col(0), v = axes.col(1);
        CHECK_NEAR(u.dot(v), 0.0, kRounding);
        CHECK_NEAR(v, normal.cross(u), kRounding);
        CHECK_NEAR(warp.dot(v), 0.0, kRounding);
        CHECK(warp.dot(u) > 0.0);
        ++cases_hit;
    }
    CHECK(cases_hit == 50);
}

TEST(a_warp_along_the_normal_gives_way_to_another_axis) {
    const TriangleMesh mesh = fixtures::grid(1, 1, 1.0);
    for (const Vec3& warp : {Vec3(0, 0, 1), Vec3(0, 0, -3), Vec3(0, 0.05, 1)}) {
        const Cloth cloth = build(mesh, warp);
        for (const ClothTriangle& triangle : cloth.triangles) {
            const Vec3 u = material_axes(cloth, triangle).col(0);
            CHECK_NEAR(u, Vec3(Vec3::UnitX()), kRounding);
        }
    }
    const Cloth slanted = build(mesh, {0, 0.2, 1});  // far enough off the normal to say where the warp goes
    const Vec3 u = material_axes(slanted, slanted.triangles[0]).col(0);
    CHECK_NEAR(u, Vec3(Vec3::UnitY()), kRounding);
}

TEST(rest_angles_of_folds) {
    for (const double angle : {0.4, -0.4, 2.5, 0.5 * kPi}) {
        NOTE(angle);
        TriangleMesh mesh = fixtures::folded_pair(angle);
        const Cloth cloth = build(mesh);
        CHECK(cloth.hinges.size() == 1);
        CHECK_NEAR(cloth.hinges[0].rest_angle, angle, 1e-15);
        CHECK_NEAR(cloth.hinges[0].weight, fixtures::kFoldedPairWeight, kRounding);
        std::swap(mesh.triangles[1][0], mesh.triangles[1][1]);  // the sense of a triangle does not matter
        CHECK(build(mesh).hinges[0].rest_angle == cloth.hinges[0].rest_angle);
    }
}

TEST(a_moebius_strip_is_cloth) {
    const TriangleMesh mesh = moebius_strip(24);
    const Cloth cloth = build(mesh, Vec3::UnitZ());
    CHECK(cloth.hinges.size() == 48);
    for (const ClothHinge& hinge : cloth.hinges) CHECK(std::abs(hinge.rest_angle) < 0.5);
}

TEST(what_is_no_cloth_is_refused) {
    const TriangleMesh good = fixtures::grid(2, 2, 1.0);
    CHECK_THROWS_WITH(build(good, Vec3::Zero()), std::invalid_argument, "warp");
    CHECK_THROWS_WITH(build({good.vertices, {}}), std::invalid_argument, "at least one triangle");

    TriangleMesh bad = good;
    bad.triangles[3][1] = 9;
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "triangle 3 (1, 9, 4): node out of range");
    bad.triangles[3][1] = -1;
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "triangle 3 (1, -1, 4)");

    bad = good;
    bad.triangles.emplace_back(0, 1, 2);
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "triangle 8 (0, 1, 2) has no area");
    bad.triangles.back() = {4, 4, 5};
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "triangle 8 (4, 4, 5) has no area");
    bad = good;
    bad.vertices[8].x() = std::nan("");
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "triangle 6 (4, 5, 8) has no area, or corners");

    bad = good;
    bad.vertices.emplace_back(0.5, 0.5, 1.0);
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "node 9 belongs to no triangle");
    bad.triangles.emplace_back(0, 4, 9);
    CHECK_THROWS_WITH(build(bad), std::invalid_argument, "edge (0, 4) belongs to 3 triangles");

    const TriangleMesh leaf{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}, {{0, 1, 2}, {0, 2, 1}}};
    CHECK_THROWS_WITH(build(leaf), std::invalid_argument, "triangles 0 and 1 have the same corners");
}

}  // namespace test_cloth
