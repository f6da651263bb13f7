#include "collision/candidates.hpp"

#include <algorithm>
#include <array>
#include <set>
#include <tuple>

#include "geometry/distance.hpp"
#include "sweep_fixtures.hpp"

namespace test_candidates {

using namespace diffsim;
using fixtures::DeformingSweep;
using fixtures::random_rotation;
using fixtures::random_sheet;
using fixtures::random_vec3;
using fixtures::segment;

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
    if (swept.begin != nullptr) {
        for (std::size_t v = 0; v < swept.mesh->vertices.size(); ++v)
            result.push_back((1.0 - s) * swept.begin[v] + s * swept.end[v]);
        return result;
    }
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

/// All pairs of features nearer than `reach` at some sampled time of the one's motion and of the other's, by trying all
/// of them: one may be stopped where the other goes on.
std::set<Key> near_pairs(const SweptMesh& a, const SweptMesh& b, double reach) {
    std::set<Key> result;
    constexpr std::array<std::array<double, 2>, 8> kTimes = {
        {{0.0, 0.0}, {0.3, 0.3}, {0.5, 0.5}, {0.8, 0.8}, {1.0, 1.0}, {0.0, 1.0}, {1.0, 0.0}, {0.2, 0.7}}};
    for (const auto& [time_a, time_b] : kTimes) {
        const std::vector<Vec3> xa = vertices_at(a, time_a), xb = vertices_at(b, time_b);
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

/// All pairs of features of one mesh without a common vertex and nearer than `reach` at some sampled time.
std::set<Key> near_self_pairs(const SweptMesh& swept, double reach) {
    std::set<Key> result;
    const CollisionMesh& mesh = *swept.mesh;
    for (const double s : {0.0, 0.3, 0.5, 0.8, 1.0}) {
        const std::vector<Vec3> x = vertices_at(swept, s);
        for (const int v : mesh.active_vertices)
            for (int p = 0; p < static_cast<int>(mesh.patches.size()); ++p) {
                const std::vector<int>& loop = mesh.patches[p].vertices;
                if (std::find(loop.begin(), loop.end(), v) == loop.end() &&
                    vertex_patch_distance(x[v], mesh, x, p) < reach)
                    result.emplace(0, v, p);
            }
        for (int a = 0; a < static_cast<int>(mesh.edges.size()); ++a)
            for (int b = a + 1; b < static_cast<int>(mesh.edges.size()); ++b) {
                const Edge &ea = mesh.edges[a], &eb = mesh.edges[b];
                const bool share = ea.p0 == eb.p0 || ea.p0 == eb.p1 || ea.p1 == eb.p0 || ea.p1 == eb.p1;
                if (!share && edge_distance(ea, x, eb, x) < reach) result.emplace(2, a, b);
            }
    }
    return result;
}

/// Pairs of one mesh whatever feature comes first: vertex and patch, or the smaller edge first.
std::set<Key> self_keys(const std::vector<FeaturePair>& pairs) {
    std::set<Key> result;
    for (const FeaturePair& p : pairs) {
        if (p.type == ContactType::edge_edge)
            result.emplace(2, std::min(p.feature_a, p.feature_b), std::max(p.feature_a, p.feature_b));
        else if (p.type == ContactType::vertex_patch)
            result.emplace(0, p.feature_a, p.feature_b);
        else
            result.emplace(0, p.feature_b, p.feature_a);
    }
    return result;
}

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

TEST(pairs_dropped_as_distant_do_not_come_near) {
    const CollisionMesh box = fixtures::collision_mesh(fixtures::box(Vec3(0.3, 0.2, 0.25)));
    const Cloth cloth = fixtures::cloth(fixtures::grid(9, 3, 0.15));
    check::Random random(12);
    std::size_t near = 0, dropped = 0;
    for (int k = 0; k < 30; ++k) {
        NOTE(k);
        DeformingSweep sheet = random_sheet(cloth, random, k % 3 == 0 ? 0.0 : 0.3, 0.02);
        const SweptMesh swept = sheet.swept();
        const auto drop = [&](const SweptMesh& other, std::vector<FeaturePair> pairs) {
            const std::size_t all = pairs.size();
            drop_distant_pairs(other, swept, pairs);
            dropped += all - pairs.size();
            return pairs;
        };
        std::vector<FeaturePair> pairs;
        collect_self_pairs(swept, pairs);
        const std::set<Key> own = self_keys(drop(swept, pairs)), own_near = near_self_pairs(swept, 0.04);
        CHECK(std::includes(own.begin(), own.end(), own_near.begin(), own_near.end()));

        const SweptMesh rigid{&box, random_sweep(random, 0.3, k % 2 == 0 ? 0.0 : 0.6), 0.05};
        pairs.clear();
        collect_feature_pairs(rigid, swept, pairs);
        const std::set<Key> others = keys(drop(rigid, pairs)), others_near = near_pairs(rigid, swept, 0.07);
        CHECK(std::includes(others.begin(), others.end(), others_near.begin(), others_near.end()));
        near += own_near.size() + others_near.size();
    }
    CHECK(near >= 500);
    CHECK(dropped >= 500);
}

TEST(only_what_moves_towards_each_other_is_near_in_a_flat_sheet) {
    const Cloth cloth = fixtures::cloth(fixtures::grid(9, 3, 0.15));
    DeformingSweep sheet{
        &cloth.surface, cloth.rest, fixtures::moved(cloth.rest, Mat3::Identity(), Vec3(0, 0, -1)), 0.02};
    const SweptMesh swept = sheet.swept();
    std::vector<FeaturePair> pairs;
    collect_self_pairs(swept, pairs);
    CHECK(pairs.size() >= 50);
    drop_distant_pairs(swept, swept, pairs);
    CHECK(pairs.empty());
}

TEST(no_pair_of_a_deforming_mesh_is_missing_or_listed_twice) {
    const CollisionMesh box = fixtures::collision_mesh(fixtures::box(Vec3(0.3, 0.2, 0.25)));
    const Cloth first = fixtures::cloth(fixtures::grid(9, 3, 0.15)), second = fixtures::cloth(fixtures::hexagon(0.4));
    check::Random random(11);
    std::size_t cases_hit = 0, quiet = 0;
    for (int k = 0; k < 30; ++k) {
        NOTE(k);
        const double motion = k % 3 == 0 ? 0.0 : 0.3;
        DeformingSweep sheet = random_sheet(first, random, motion, 0.02),
                       other = random_sheet(second, random, 0.1, 0.01);
        const SweptMesh a{&box, random_sweep(random, 0.8, motion), 0.01}, b = sheet.swept(), c = other.swept();
        for (const auto& [one, two] : {std::pair(a, b), std::pair(b, a), std::pair(b, c), std::pair(a, c)}) {
            std::vector<FeaturePair> pairs;
            collect_feature_pairs(one, two, pairs);
            const std::set<Key> found = keys(pairs), expected = near_pairs(one, two, one.reach + two.reach);
            CHECK(found.size() == pairs.size());
            CHECK(std::includes(found.begin(), found.end(), expected.begin(), expected.end()));
            cases_hit += expected.size();
            quiet += pairs.empty() ? 1 : 0;
        }
    }
    CHECK(cases_hit >= 500);
    CHECK(quiet >= 3);
}

TEST(no_pair_of_a_mesh_with_itself_is_missing_or_listed_twice) {
    const Cloth cloth = fixtures::cloth(fixtures::grid(12, 3, 0.15));
    check::Random random(12);
    std::size_t cases_hit = 0, all = 0, listed = 0;
    for (int k = 0; k < 12; ++k) {
        NOTE(k);
        DeformingSweep sheet = random_sheet(cloth, random, k % 2 == 0 ? 0.0 : 0.1, 0.02);
        std::vector<FeaturePair> pairs;
        collect_self_pairs(sheet.swept(), pairs);
        const std::set<Key> found = self_keys(pairs), expected = near_self_pairs(sheet.swept(), 0.04);
        CHECK(found.size() == pairs.size());
        CHECK(std::includes(found.begin(), found.end(), expected.begin(), expected.end()));
        const std::set<Key> without_neighbours = near_self_pairs(sheet.swept(), kInfinity);
        CHECK(std::includes(without_neighbours.begin(), without_neighbours.end(), found.begin(), found.end()));
        cases_hit += expected.size();
        listed += found.size();
        all += without_neighbours.size();
    }
    CHECK(cases_hit >= 200);
    CHECK(listed < all / 4);
}

TEST(candidates_are_about_as_few_as_they_can_be) {
    // Face to face, 0.1 apart: the pairs of the two faces, their corners and edges, and nothing of the far sides.
    const CollisionMesh cube = fixtures::collision_mesh(fixtures::box(Vec3(1, 1, 1)));
    const Pose above{Mat3::Identity(), Vec3(0, 0, 2.1)};
    std::vector<FeaturePair> pairs;
    collect_feature_pairs(SweptMesh{&cube, {Pose(), Pose()}, 0.06}, SweptMesh{&cube, {above, above}, 0.06}, pairs);
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
    collect_feature_pairs(SweptMesh{&cube, {Pose(), Pose()}, 0.06}, SweptMesh{&cube, {far, far}, 0.06}, pairs);
    CHECK(pairs.empty());
}

TEST(points_and_segments_meet_each_other_once) {
    const CollisionMesh ball = point(), rod = segment();
    const auto count = [&](const CollisionMesh& a, const CollisionMesh& b) {
        std::vector<FeaturePair> pairs;
        const Pose crossed{exp_rotation(Vec3(0, 0, 1.2)), Vec3(0.1, 0, 0.2)};
        collect_feature_pairs(SweptMesh{&a, {Pose(), Pose()}, 0.2}, SweptMesh{&b, {crossed, crossed}, 0.2}, pairs);
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

TEST(nodes_below_a_height_are_those_of_brute_force) {
    const Cloth cloth = fixtures::cloth(fixtures::grid(6, 3, 0.2));
    check::Random random(13);
    std::size_t cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        DeformingSweep sheet = random_sheet(cloth, random, 0.2, 0.05);
        const double height = random.uniform(-1.0, 0.0);
        std::vector<int> expected, found;
        for (int v = 0; v < cloth.node_count(); ++v)
            if (std::min(sheet.begin[v].z(), sheet.end[v].z()) - 0.05 <= height) expected.push_back(v);
        collect_vertices_below(sheet.swept(), height, found);
        CHECK(found == expected);
        cases_hit += expected.size();
    }
    CHECK(cases_hit >= 30);
}

}  // namespace test_candidates
