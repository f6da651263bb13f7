#include "collision/candidates.hpp"

#include <algorithm>
#include <set>
#include <tuple>

#include "fixtures.hpp"
#include "geometry/distance.hpp"

using namespace diffsim;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

using Key = std::tuple<int, int, int>;

std::set<Key> keys(const std::vector<FeaturePair>& pairs) {
    std::set<Key> result;
    for (const FeaturePair& p : pairs) result.emplace(static_cast<int>(p.type), p.feature_a, p.feature_b);
    return result;
}

/// Vertices at time s of a motion on straight lines.
std::vector<Vec3> vertices_at(const SweptMesh& swept, double s) {
    std::vector<Vec3> result;
    for (const Vec3& x : swept.mesh->vertices)
        result.push_back((1.0 - s) * (swept.sweep.begin * x) + s * (swept.sweep.end * x));
    return result;
}

double vertex_patch_distance(const Vec3& x, const CollisionMesh& mesh, const std::vector<Vec3>& vertices, int patch) {
    std::vector<Vec3> corners;
    for (const int v : mesh.patches[patch].vertices) corners.push_back(vertices[v]);
    const int count = static_cast<int>(corners.size());
    return closest_vertex_polygon(x, {corners.data(), count, polygon_normal(corners.data(), count)}).distance();
}

double edge_distance(const Edge& a, const std::vector<Vec3>& xa, const Edge& b, const std::vector<Vec3>& xb) {
    return closest_edge_edge(xa[a.p0], xa[a.p1], xb[b.p0], xb[b.p1]).distance();
}

/// All pairs of features nearer than `reach` at some sampled time, by trying all of them.
std::set<Key> near_pairs(const SweptMesh& a, const SweptMesh& b, double reach) {
    std::set<Key> result;
    for (const double s : {0.0, 0.3, 0.5, 0.8, 1.0}) {
        const std::vector<Vec3> xa = vertices_at(a, s), xb = vertices_at(b, s);
        for (const int v : a.mesh->active_vertices)
            for (int p = 0; p < static_cast<int>(b.mesh->patches.size()); ++p)
                if (vertex_patch_distance(xa[v], *b.mesh, xb, p) < reach)
                    result.emplace(static_cast<int>(ContactType::vertex_patch), v, p);
        for (const int v : b.mesh->active_vertices)
            for (int p = 0; p < static_cast<int>(a.mesh->patches.size()); ++p)
                if (vertex_patch_distance(xb[v], *a.mesh, xa, p) < reach)
                    result.emplace(static_cast<int>(ContactType::patch_vertex), p, v);
        for (int ea = 0; ea < static_cast<int>(a.mesh->edges.size()); ++ea)
            for (int eb = 0; eb < static_cast<int>(b.mesh->edges.size()); ++eb)
                if (edge_distance(a.mesh->edges[ea], xa, b.mesh->edges[eb], xb) < reach)
                    result.emplace(static_cast<int>(ContactType::edge_edge), ea, eb);
    }
    return result;
}

Sweep random_sweep(check::Random& random, double spread, double motion) {
    const Pose begin{random_rotation(random), random_vec3(random, spread)};
    return {begin, {exp_rotation(random_vec3(random, motion)) * begin.R, begin.t + random_vec3(random, motion)}};
}

CollisionMesh segment() { return build_collision_mesh({Vec3(-1, 0, 0), Vec3(1, 0, 0)}, {}); }
CollisionMesh point() { return build_collision_mesh({Vec3::Zero()}, {}); }

}  // namespace

TEST(no_pair_nearer_than_the_reach_is_missing_or_listed_twice) {
    const std::vector<CollisionMesh> meshes = {
        fixtures::collision_mesh(fixtures::box(Vec3(0.5, 0.4, 0.6))), fixtures::collision_mesh(fixtures::l_shape()),
        fixtures::collision_mesh(fixtures::tetrahedron(0.7))};
    check::Random random(1);
    std::size_t cases_hit = 0, quiet = 0;
    for (int k = 0; k < 90; ++k) {
        NOTE(k);
        const double motion = k % 3 == 0 ? 0.0 : 0.6;
        const SweptMesh a{&meshes[k % 3], random_sweep(random, 0.8, motion), 0.05};
        const SweptMesh b{&meshes[k / 3 % 3], random_sweep(random, 0.8, motion), 0.1};
        std::vector<FeaturePair> pairs;
        collect_feature_pairs(a, b, pairs);
        const std::set<Key> found = keys(pairs), expected = near_pairs(a, b, a.reach + b.reach);
        CHECK(found.size() == pairs.size());
        CHECK(std::includes(found.begin(), found.end(), expected.begin(), expected.end()));
        cases_hit += expected.size();
        quiet += pairs.empty() ? 1 : 0;
    }
    CHECK(cases_hit >= 500);
    CHECK(quiet >= 3);  // "all pairs, always" would be complete too
}

TEST(candidates_are_about_as_few_as_they_can_be) {
    // Face to face, 0.1 apart: the pairs of the two faces, their corners and edges, and nothing of the far sides.
    const CollisionMesh cube = fixtures::collision_mesh(fixtures::box(Vec3(1, 1, 1)));
    const Pose above{Mat3::Identity(), Vec3(0, 0, 2.1)};
    std::vector<FeaturePair> pairs;
    collect_feature_pairs({&cube, {Pose(), Pose()}, 0.06}, {&cube, {above, above}, 0.06}, pairs);
    int faces = 0;
    for (const FeaturePair& p : pairs) {
        if (p.type == ContactType::vertex_patch) {
            CHECK(cube.vertices[p.feature_a].z() == 1.0);
            faces += cube.patches[p.feature_b].normal.z() == -1.0 ? 1 : 0;
        }
        if (p.type == ContactType::edge_edge)
            CHECK(
                std::max(
                    cube.vertices[cube.edges[p.feature_a].p0].z(), cube.vertices[cube.edges[p.feature_a].p1].z()) ==
                1.0);
    }
    CHECK(faces == 4);
    pairs.clear();
    const Pose far{Mat3::Identity(), Vec3(0, 0, 2.2)};
    collect_feature_pairs({&cube, {Pose(), Pose()}, 0.06}, {&cube, {far, far}, 0.06}, pairs);
    CHECK(pairs.empty());
}

TEST(points_and_segments_meet_each_other_once) {
    const CollisionMesh ball = point(), rod = segment();
    const auto count = [&](const CollisionMesh& a, const CollisionMesh& b) {
        std::vector<FeaturePair> pairs;
        const Pose crossed{exp_rotation(Vec3(0, 0, 1.2)), Vec3(0.1, 0, 0.2)};
        collect_feature_pairs({&a, {Pose(), Pose()}, 0.2}, {&b, {crossed, crossed}, 0.2}, pairs);
        CHECK(keys(pairs).size() == pairs.size());
        return pairs.size();
    };
    CHECK(count(ball, ball) == 1);
    CHECK(count(ball, rod) == 1);
    CHECK(count(rod, ball) == 1);
    CHECK(count(rod, rod) >= 1);
}

TEST(the_nearest_listed_pair_has_the_distance_of_the_objects) {
    const std::vector<CollisionMesh> meshes = {
        point(), segment(), fixtures::collision_mesh(fixtures::tetrahedron(0.7)),
        fixtures::collision_mesh(fixtures::box(Vec3(0.5, 0.4, 0.6)))};
    check::Random random(2);
    int cases_hit = 0;
    for (int k = 0; k < 96; ++k) {
        NOTE(k);
        const SweptMesh a{&meshes[k % 4], random_sweep(random, 1.0, 0.0), 2.0};
        const SweptMesh b{&meshes[k / 4 % 4], random_sweep(random, 1.0, 0.0), 2.0};
        const std::vector<Vec3> xa = vertices_at(a, 0.0), xb = vertices_at(b, 0.0);
        // A convex shape's distance is that of some vertex and patch or of two edges.
        double expected = kInfinity, found = kInfinity;
        for (const Vec3& x : xa)
            for (int p = 0; p < static_cast<int>(b.mesh->patches.size()); ++p)
                expected = std::min(expected, vertex_patch_distance(x, *b.mesh, xb, p));
        for (const Vec3& x : xb)
            for (int p = 0; p < static_cast<int>(a.mesh->patches.size()); ++p)
                expected = std::min(expected, vertex_patch_distance(x, *a.mesh, xa, p));
        for (const Edge& ea : a.mesh->edges)
            for (const Edge& eb : b.mesh->edges) expected = std::min(expected, edge_distance(ea, xa, eb, xb));
        std::vector<FeaturePair> pairs;
        collect_feature_pairs(a, b, pairs);
        for (const FeaturePair& p : pairs) {
            if (p.type == ContactType::vertex_patch)
                found = std::min(found, vertex_patch_distance(xa[p.feature_a], *b.mesh, xb, p.feature_b));
            else if (p.type == ContactType::patch_vertex)
                found = std::min(found, vertex_patch_distance(xb[p.feature_b], *a.mesh, xa, p.feature_a));
            else
                found = std::min(found, edge_distance(a.mesh->edges[p.feature_a], xa, b.mesh->edges[p.feature_b], xb));
        }
        CHECK_NEAR(found, expected, 1e-12);  // the same number, or one that rounds differently from another pair
        cases_hit += expected > 0.1 ? 1 : 0;
    }
    CHECK(cases_hit >= 40);
}

TEST(vertices_below_a_height_are_those_of_brute_force) {
    const CollisionMesh mesh = fixtures::collision_mesh(fixtures::l_shape());
    check::Random random(3);
    std::size_t cases_hit = 0;
    for (int k = 0; k < 100; ++k) {
        const SweptMesh swept{&mesh, random_sweep(random, 1.5, 0.5), 0.1};
        const double height = -0.5;
        std::vector<int> expected, found;
        for (const int v : mesh.active_vertices) {
            const double lowest =
                std::min((swept.sweep.begin * mesh.vertices[v]).z(), (swept.sweep.end * mesh.vertices[v]).z());
            if (lowest - swept.reach <= height) expected.push_back(v);
        }
        collect_vertices_below(swept, height, found);
        CHECK(found == expected);
        cases_hit += expected.size();
    }
    CHECK(cases_hit >= 100);
}

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
        CHECK(meshes_cross(mesh_a, a, mesh_b, b) == overlap);
        CHECK(meshes_cross(mesh_b, b, mesh_a, a) == overlap);
        (overlap ? crossing : apart) += 1;
    }
    CHECK(crossing >= 50);
    CHECK(apart >= 50);
}

TEST(a_mesh_inside_another_does_not_cross_it) {
    const CollisionMesh large = fixtures::collision_mesh(fixtures::box(Vec3(1.0, 1.0, 1.0)));
    const CollisionMesh small = fixtures::collision_mesh(fixtures::box(Vec3(0.1, 0.1, 0.1)));
    CHECK(!meshes_cross(large, Pose{}, small, Pose{}));
    CHECK(meshes_cross(large, Pose{}, small, Pose{Mat3::Identity(), Vec3(1.0, 0.2, 0.3)}));
}
