#include "geometry/collision_mesh.hpp"

#include <algorithm>
#include <map>
#include <stdexcept>

#include "fixtures.hpp"
#include "geometry/distance.hpp"

namespace test_collision_mesh {

using namespace diffsim;
using fixtures::TriangleMesh;

namespace {

constexpr double kRounding = 1e-13;  // of lengths and areas of order 1

/// The surface of a cube of side 2, every face an n x n grid of squares cut into triangles.
TriangleMesh subdivided_cube(int n) {
    TriangleMesh mesh;
    std::map<std::vector<int>, int> ids;
    const auto vertex = [&](int axis, int side, int u, int v) {
        std::vector<int> key(3);
        key[axis] = side * n;
        key[(axis + 1) % 3] = u;
        key[(axis + 2) % 3] = v;
        const auto [found, is_new] = ids.emplace(key, static_cast<int>(mesh.vertices.size()));
        if (is_new) mesh.vertices.emplace_back(2.0 * key[0] / n - 1.0, 2.0 * key[1] / n - 1.0, 2.0 * key[2] / n - 1.0);
        return found->second;
    };
    for (int axis = 0; axis < 3; ++axis)
        for (int side = 0; side < 2; ++side)
            for (int u = 0; u < n; ++u)
                for (int v = 0; v < n; ++v) {
                    int loop[4] = {
                        vertex(axis, side, u, v), vertex(axis, side, u + 1, v), vertex(axis, side, u + 1, v + 1),
                        vertex(axis, side, u, v + 1)};
                    if (side == 0) std::swap(loop[1], loop[3]);
                    mesh.triangles.emplace_back(loop[0], loop[1], loop[2]);
                    mesh.triangles.emplace_back(loop[0], loop[2], loop[3]);
                }
    return mesh;
}

double triangle_area(const Vec3& a, const Vec3& b, const Vec3& c) { return 0.5 * (b - a).cross(c - a).norm(); }

/// What must hold for every mesh with faces.
void check_invariants(const TriangleMesh& source, const CollisionMesh& mesh) {
    double source_area = 0.0, patch_area = 0.0, radius = 0.0;
    for (const Eigen::Vector3i& t : source.triangles)
        source_area += triangle_area(source.vertices[t[0]], source.vertices[t[1]], source.vertices[t[2]]);
    for (const Vec3& x : source.vertices) radius = std::max(radius, x.norm());
    CHECK_NEAR(mesh.radius, radius, kRounding);

    for (const Patch& patch : mesh.patches) {
        const int count = static_cast<int>(patch.vertices.size());
        std::vector<Vec3> corners;
        for (const int v : patch.vertices) corners.push_back(mesh.vertices[v]);
        CHECK_NEAR(patch.normal, polygon_normal(corners.data(), count), kRounding);
        for (int k = 0; k < count; ++k) {
            const Vec3 in = corners[(k + 1) % count] - corners[k];
            const Vec3 out = corners[(k + 2) % count] - corners[(k + 1) % count];
            CHECK(patch.normal.dot(in.cross(out)) > -kRounding);                    // convex
            CHECK_NEAR(patch.normal.dot(corners[k] - corners[0]), 0.0, kRounding);  // flat
            if (k > 0 && k + 1 < count) patch_area += triangle_area(corners[0], corners[k], corners[k + 1]);
        }
    }
    CHECK_NEAR(patch_area, source_area, kRounding * source_area);

    std::vector<int> vertex_times(mesh.vertices.size(), 0), edge_times(mesh.edges.size(), 0);
    std::vector<int> patch_times(mesh.patches.size(), 0);
    std::vector<char> has_edge(mesh.vertices.size(), 0);
    for (const Edge& edge : mesh.edges) has_edge[edge.p0] = has_edge[edge.p1] = 1;
    for (const Cell& cell : mesh.cells) {
        ++patch_times[cell.patch];
        for (const int v : cell.vertices) ++vertex_times[v];
        for (const int e : cell.edges) ++edge_times[e];
    }
    for (const int times : patch_times) CHECK(times == 1);
    for (const int times : edge_times) CHECK(times == 1);
    std::vector<int> active;
    for (std::size_t v = 0; v < mesh.vertices.size(); ++v) {
        CHECK(vertex_times[v] == (has_edge[v] ? 1 : 0));
        if (has_edge[v]) active.push_back(static_cast<int>(v));
    }
    CHECK(mesh.active_vertices == active);

    // The tree's leaves are the cells, and their boxes hold all that a cell names.
    std::vector<int> cell_times(mesh.cells.size(), 0);
    for (const BoxTree::Node& node : mesh.tree.nodes) {
        if (!node.is_leaf()) continue;
        ++cell_times[node.item];
        const Cell& cell = mesh.cells[node.item];
        std::vector<int> named = mesh.patches[cell.patch].vertices;
        named.insert(named.end(), cell.vertices.begin(), cell.vertices.end());
        for (const int e : cell.edges) named.insert(named.end(), {mesh.edges[e].p0, mesh.edges[e].p1});
        for (const int v : named) CHECK(node.box.overlaps({mesh.vertices[v], mesh.vertices[v]}));
    }
    for (const int times : cell_times) CHECK(times == 1);
}

}  // namespace

TEST(a_cube_has_six_patches_twelve_edges_eight_vertices) {
    const TriangleMesh cube = fixtures::box(Vec3(1, 1, 1));
    CHECK(cube.triangles.size() == 12);
    const CollisionMesh mesh = fixtures::collision_mesh(cube);
    check_invariants(cube, mesh);
    CHECK(mesh.patches.size() == 6);
    CHECK(mesh.edges.size() == 12);
    CHECK(mesh.active_vertices.size() == 8);
    CHECK(mesh.closed);
    for (const Patch& patch : mesh.patches) {
        CHECK(patch.vertices.size() == 4);
        CHECK(patch.normal.dot(mesh.vertices[patch.vertices[0]]) > 0.9);  // outward
    }
    for (const Edge& edge : mesh.edges) {
        const Vec3 middle = 0.5 * (mesh.vertices[edge.p0] + mesh.vertices[edge.p1]);
        CHECK_NEAR(edge.outward, middle, kRounding);  // two of ±1 and a zero, like the sum of the two normals
    }
}

TEST(nonconvex_faces_are_split_into_convex_patches) {
    const TriangleMesh shape = fixtures::l_shape();
    const CollisionMesh mesh = fixtures::collision_mesh(shape);
    check_invariants(shape, mesh);
    CHECK(mesh.patches.size() == 6 + 2 * 2);  // sides, and each cap as two
    CHECK(mesh.edges.size() == 18);
    CHECK(mesh.active_vertices.size() == 12);
    CHECK(mesh.closed);
}

TEST(a_subdivided_face_is_no_finer_than_its_outline) {
    for (const int n : {2, 3, 5}) {
        NOTE(n);
        const TriangleMesh cube = subdivided_cube(n);
        const CollisionMesh mesh = fixtures::collision_mesh(cube);
        check_invariants(cube, mesh);
        CHECK(mesh.closed);
        CHECK(mesh.edges.size() == static_cast<std::size_t>(12 * n));
        CHECK(mesh.active_vertices.size() == static_cast<std::size_t>(8 + 12 * (n - 1)));  // none inside a face
        CHECK(mesh.patches.size() < cube.triangles.size() / 2);
    }
}

TEST(coplanar_within_single_precision_counts_as_flat) {
    TriangleMesh cube = subdivided_cube(2);
    check::Random random(1);
    for (Vec3& x : cube.vertices) x = (x + 1e-8 * fixtures::random_vec3(random)).cast<float>().cast<double>();
    const CollisionMesh mesh = fixtures::collision_mesh(cube);
    CHECK(mesh.edges.size() == 24);
    CHECK(mesh.active_vertices.size() == 20);
}

TEST(a_tetrahedron_keeps_its_faces) {
    const TriangleMesh shape = fixtures::tetrahedron();
    const CollisionMesh mesh = fixtures::collision_mesh(shape);
    check_invariants(shape, mesh);
    CHECK(mesh.patches.size() == 4);
    CHECK(mesh.edges.size() == 6);
    CHECK(mesh.active_vertices.size() == 4);
}

TEST(open_meshes_have_no_inside) {
    TriangleMesh open = fixtures::box(Vec3(1, 1, 1));
    const auto is_top = [&](const Eigen::Vector3i& t) {
        return open.vertices[t[0]].z() + open.vertices[t[1]].z() + open.vertices[t[2]].z() > 2.9;
    };
    open.triangles.erase(std::remove_if(open.triangles.begin(), open.triangles.end(), is_top), open.triangles.end());
    const CollisionMesh mesh = fixtures::collision_mesh(open);
    check_invariants(open, mesh);
    CHECK(mesh.patches.size() == 5);
    CHECK(mesh.edges.size() == 12);
    CHECK(!mesh.closed);
    int rims = 0;
    for (const Edge& edge : mesh.edges) rims += edge.outward.isZero(0.0) ? 1 : 0;
    CHECK(rims == 4);

    const TriangleMesh square{{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}}, {{0, 1, 2}, {0, 2, 3}}};
    const CollisionMesh flat = fixtures::collision_mesh(square);
    check_invariants(square, flat);
    CHECK(flat.patches.size() == 1);
    CHECK(flat.edges.size() == 4);
    CHECK(!flat.closed);

    // A sheet of two sides: every edge has two faces, but they look away from each other.
    const TriangleMesh leaf{{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}, {{0, 1, 2}, {0, 2, 1}}};
    const CollisionMesh two_sided = fixtures::collision_mesh(leaf);
    check_invariants(leaf, two_sided);
    CHECK(two_sided.patches.size() == 2);
    CHECK(two_sided.edges.size() == 3);
}

TEST(separate_faces_stay_triangles) {
    const TriangleMesh cube = subdivided_cube(2);
    const CollisionMesh mesh = build_collision_mesh(cube.vertices, cube.triangles, Faces::separate);
    check_invariants(cube, mesh);
    CHECK(mesh.patches.size() == cube.triangles.size());
    for (std::size_t f = 0; f < cube.triangles.size(); ++f) {
        const Eigen::Vector3i& t = cube.triangles[f];
        CHECK(mesh.patches[f].vertices == std::vector<int>{t[0], t[1], t[2]});
    }
    CHECK(mesh.edges.size() == cube.triangles.size() * 3 / 2);
    CHECK(mesh.active_vertices.size() == cube.vertices.size());
    CHECK(mesh.closed);

    const TriangleMesh square{{{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}}, {{0, 1, 2}, {0, 2, 3}}};
    const CollisionMesh flat = build_collision_mesh(square.vertices, square.triangles, Faces::separate);
    check_invariants(square, flat);
    CHECK(flat.patches.size() == 2);
    CHECK(flat.edges.size() == 5);
    CHECK(!flat.closed);
}

TEST(points_and_segments) {
    const CollisionMesh point = build_collision_mesh({Vec3::Zero()}, {});
    CHECK(point.active_vertices == std::vector<int>{0});
    CHECK(point.edges.empty());
    CHECK(point.patches.size() == 1);
    CHECK(point.radius == 0.0);
    CHECK(!point.closed);
    const CollisionMesh segment = build_collision_mesh({Vec3(0, 0, -2), Vec3(0, 0, 1)}, {});
    CHECK(segment.active_vertices == std::vector<int>{0, 1});
    CHECK(segment.edges.size() == 1);
    CHECK(segment.cells.size() == 1);
    CHECK(segment.radius == 2.0);
    CHECK(segment.patches[0].normal.isZero(0.0));
}

TEST(what_is_no_mesh_is_refused) {
    const std::vector<Vec3> three = {Vec3::Zero(), Vec3::UnitX(), Vec3::UnitY()};
    CHECK_THROWS(build_collision_mesh({}, {}), std::invalid_argument);
    CHECK_THROWS(build_collision_mesh(three, {}), std::invalid_argument);
    CHECK_THROWS_WITH(build_collision_mesh(three, {{0, 1, 3}}), std::invalid_argument, "out of range");
    CHECK_THROWS_WITH(build_collision_mesh(three, {{0, 1, -1}}), std::invalid_argument, "out of range");
}

}  // namespace test_collision_mesh
