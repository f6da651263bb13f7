#include "geometry/distance.hpp"

#include <algorithm>

#include "fixtures.hpp"

namespace test_distance {

using namespace diffsim;
using fixtures::random_direction;
using fixtures::random_polygon;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kRounding = 1e-13;  // of lengths of order 1
// The reference searches along a parameter: its distances are off by the root of the rounding in their squares.
constexpr double kSearch = 3e-8;

/// Minimum of a convex function over [0, 1].
template <typename Function>
double ternary_search(const Function& function) {
    double low = 0.0, high = 1.0;
    for (int k = 0; k < 100; ++k) {
        const double left = low + (high - low) / 3.0, right = high - (high - low) / 3.0;
        (function(left) < function(right) ? high : low) = function(left) < function(right) ? right : left;
    }
    return std::min({function(0.0), function(1.0), function(0.5 * (low + high))});
}

double point_segment(const Vec3& x, const Vec3& p0, const Vec3& p1) {
    const Vec3 d = p1 - p0;
    const double t = d.squaredNorm() > 0.0 ? std::clamp((x - p0).dot(d) / d.squaredNorm(), 0.0, 1.0) : 0.0;
    return (x - p0 - t * d).norm();
}

double segment_segment(const Vec3& a0, const Vec3& a1, const Vec3& b0, const Vec3& b1) {
    return ternary_search([&](double s) { return point_segment(a0 + s * (a1 - a0), b0, b1); });
}

/// A triangle as the segments parallel to its base, the polygon as its triangles.
double point_polygon(const Vec3& x, const std::vector<Vec3>& p) {
    double best = point_segment(x, p.front(), p.back());
    for (std::size_t k = 1; k + 1 < p.size(); ++k)
        best = std::min(best, ternary_search([&](double s) {
                            return point_segment(x, p[0] + s * (p[k] - p[0]), p[0] + s * (p[k + 1] - p[0]));
                        }));
    return best;
}

bool near_distance(double found, double reference) {
    // Squares agree to rounding, so distances do relative to their size, and tiny ones to its root.
    return std::abs(found - reference) <= std::max(kRounding / std::max(reference, 1e-6), kRounding) ||
           std::max(found, reference) <= kSearch;
}

ClosestPoints closest(const Vec3& x, const std::vector<Vec3>& p) {
    const int count = static_cast<int>(p.size());
    return closest_vertex_polygon(x, {p.data(), count, polygon_normal(p.data(), count)});
}

/// Distance against the reference, type against code, and the edge against the offset it must be orthogonal to.
void check_vertex_polygon(const Vec3& x, const std::vector<Vec3>& p, const ClosestPoints& found) {
    const int count = static_cast<int>(p.size());
    CHECK(near_distance(found.distance(), point_polygon(x, p)));
    CHECK(point_polygon(found.b.point, p) <= kSearch);
    CHECK(found.a.point == x);
    CHECK(found.a.slide_count == 0);
    const Vec3 offset = found.a.point - found.b.point;
    if (found.b.slide_count == 2) {
        CHECK(found.feature_code == 0);
        return;
    }
    CHECK(found.feature_code >= 1);
    const int edge = static_cast<int>(found.feature_code - 1) / 3, where = static_cast<int>(found.feature_code - 1) % 3;
    CHECK(edge < count);
    const Vec3 &p0 = p[edge], &p1 = p[(edge + 1) % count];
    CHECK(found.b.slide_count == (where == 2 ? 1 : 0));
    if (where == 0) CHECK(found.b.point == p0);
    CHECK(where != 1);  // every corner has one code, as the beginning of an edge
    if (where == 2) {
        CHECK(found.b.edge == Vec3(p1 - p0));
        CHECK_NEAR(found.b.edge.normalized().dot(offset), 0.0, 10.0 * kRounding);
    }
}

struct EdgePair {
    Vec3 a0, a1, b0, b1;
};

ClosestPoints closest(const EdgePair& e) { return closest_edge_edge(e.a0, e.a1, e.b0, e.b1); }

void check_edge_edge(const EdgePair& e, double tolerance) {
    const ClosestPoints found = closest(e);
    const double reference = segment_segment(e.a0, e.a1, e.b0, e.b1);
    CHECK(near_distance(found.distance(), reference) || std::abs(found.distance() - reference) <= tolerance);
    CHECK(point_segment(found.a.point, e.a0, e.a1) <= kRounding);
    CHECK(point_segment(found.b.point, e.b0, e.b1) <= kRounding);
    const int where_a = static_cast<int>(found.feature_code) / 3, where_b = static_cast<int>(found.feature_code) % 3;
    CHECK(found.a.slide_count == (where_a == 2 ? 1 : 0));
    CHECK(found.b.slide_count == (where_b == 2 ? 1 : 0));
    CHECK(found.a.edge == Vec3(e.a1 - e.a0));
    CHECK(found.b.edge == Vec3(e.b1 - e.b0));
    if (where_a < 2) CHECK_NEAR(found.a.point, where_a == 0 ? e.a0 : e.a1, kRounding);
    if (where_b < 2) CHECK_NEAR(found.b.point, where_b == 0 ? e.b0 : e.b1, kRounding);
}

}  // namespace

TEST(vertex_polygon_agrees_with_search) {
    check::Random random(1);
    int cases_hit[3] = {0, 0, 0};  // by type: vertex-vertex, vertex-edge, vertex-face
    for (int k = 0; k < 300; ++k) {
        NOTE(k);
        const std::vector<Vec3> p = random_polygon(random, 3 + k % 18);
        const Vec3 x = random_vec3(random, 2.0);
        const ClosestPoints found = closest(x, p);
        check_vertex_polygon(x, p, found);
        ++cases_hit[found.b.slide_count];
    }
    for (const int cases : cases_hit) CHECK(cases >= 20);
}

TEST(vertex_polygon_in_degenerate_positions) {
    check::Random random(2);
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        const std::vector<Vec3> p = random_polygon(random, 3 + k % 6);
        const Vec3 n = polygon_normal(p.data(), static_cast<int>(p.size()));
        const Vec3 center = (p[0] + p[1] + p[2]) / 3.0, middle = 0.5 * (p[0] + p[1]);
        const Vec3 beside = middle + 0.1 * (p[1] - p[0]).cross(n).normalized();
        for (const Vec3& x :
             {center, middle, p[0], Vec3(p[0] + 0.3 * n), Vec3(middle - 0.2 * n), beside,
              Vec3(p[0] + 0.5 * (p[0] - p[1])), Vec3(center + 1e-9 * n)})
            check_vertex_polygon(x, p, closest(x, p));
        CHECK(closest(center, p).distance() <= kRounding);
        CHECK_NEAR(closest(Vec3(p[0] + 0.3 * n), p).distance(), 0.3, kRounding);
        CHECK(closest(Vec3(center + 0.2 * n), p).feature_code == 0);
        CHECK(closest(beside, p).b.slide_count == 1);
    }
}

TEST(polygons_without_area_are_their_boundary) {
    check::Random random(3);
    for (int k = 0; k < 40; ++k) {
        const Vec3 a = random_vec3(random), b = random_vec3(random), x = random_vec3(random, 2.0);
        CHECK_NEAR(closest(x, {a}).distance(), (x - a).norm(), kRounding);
        CHECK(closest(x, {a}).b.slide_count == 0);
        CHECK_NEAR(closest(x, {a, b}).distance(), point_segment(x, a, b), kRounding);
        const Vec3 corners[3] = {a, b, a};
        CHECK(polygon_normal(corners, 3).isZero(0.0));
        CHECK_NEAR(closest(x, {a, b, a}).distance(), point_segment(x, a, b), kRounding);
    }
}

TEST(turning_the_corner_order_keeps_the_distance) {
    check::Random random(4);
    for (int k = 0; k < 50; ++k) {
        std::vector<Vec3> p = random_polygon(random, 5);
        const Vec3 x = random_vec3(random, 2.0);
        const double distance = closest(x, p).distance();
        std::rotate(p.begin(), p.begin() + 2, p.end());
        CHECK_NEAR(closest(x, p).distance(), distance, kRounding);
        std::reverse(p.begin(), p.end());
        CHECK_NEAR(closest(x, p).distance(), distance, kRounding);
    }
}

TEST(edge_edge_agrees_with_search) {
    check::Random random(5);
    int cases_hit[3] = {0, 0, 0};  // by number of interior points
    for (int k = 0; k < 400; ++k) {
        NOTE(k);
        const EdgePair e{random_vec3(random), random_vec3(random), random_vec3(random), random_vec3(random)};
        check_edge_edge(e, kRounding);
        const ClosestPoints found = closest(e), swapped = closest({e.b0, e.b1, e.a0, e.a1}),
                            turned = closest({e.a1, e.a0, e.b0, e.b1});
        CHECK_NEAR(swapped.distance(), found.distance(), kRounding);
        CHECK_NEAR(turned.distance(), found.distance(), kRounding);
        CHECK_NEAR(swapped.a.point, found.b.point, 1e-9);  // conditioned by the angle of the edges
        ++cases_hit[found.a.slide_count + found.b.slide_count];
    }
    for (const int cases : cases_hit) CHECK(cases >= 30);
}

TEST(edge_edge_in_degenerate_positions) {
    check::Random random(6);
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        const Vec3 origin = random_vec3(random);
        const Mat3 R = random_rotation(random);
        const auto at = [&](double x, double y, double z) -> Vec3 { return origin + R * Vec3(x, y, z); };
        const auto distance = [&](const EdgePair& e) {
            check_edge_edge(e, kRounding);
            return closest(e).distance();
        };
        const Vec3 a0 = at(0, 0, 0), a1 = at(1, 0, 0);
        CHECK_NEAR(distance({a0, a1, at(0.2, 0.5, 0), at(0.7, 0.5, 0)}), 0.5, kRounding);   // parallel, within
        CHECK_NEAR(distance({a0, a1, at(2, 0.5, 0), at(0.7, 0.5, 0)}), 0.5, kRounding);     // parallel, overlapping
        CHECK_NEAR(distance({a0, a1, at(4, 4, 0), at(6, 4, 0)}), 5.0, 10.0 * kRounding);    // parallel, apart
        CHECK_NEAR(distance({a0, a1, at(1.5, 0, 0), at(3, 0, 0)}), 0.5, kRounding);         // collinear, apart
        CHECK(distance({a0, a1, at(0.5, 0, 0), at(3, 0, 0)}) <= kRounding);                 // collinear, overlapping
        CHECK(distance({a0, a1, a1, at(1, 1, 0)}) <= kRounding);                            // sharing a corner
        CHECK(distance({a0, a1, at(0.3, -1, 0), at(0.3, 1, 0)}) <= kRounding);              // crossing
        CHECK_NEAR(distance({a0, a1, at(0.3, -1, 0.1), at(0.3, 1, 0.1)}), 0.1, kRounding);  // crossing above
        CHECK_NEAR(distance({a0, a1, at(1, 0.2, 0), at(1, 1, 0)}), 0.2, kRounding);         // above an end
        CHECK_NEAR(distance({a0, a0, at(1, 0.2, 0), at(1, 1, 0)}), std::sqrt(1.04), kRounding);  // no length
        CHECK_NEAR(distance({a0, a0, a1, a1}), 1.0, kRounding);
    }
}

TEST(nearly_parallel_edges_keep_their_distance) {
    // Crossing at the middle, `gap` apart. Points that are off by delta along the edges see sqrt(gap² + delta²), too
    // much: CCD, which may come this close, keeps a tolerance of a tenth.
    constexpr double kClose = 1e-4;
    check::Random random(7);
    int cases_hit = 0;
    for (const double angle : {1e-12, 1e-9, 1e-7, 0.9e-5, 1.1e-5, 1e-4, 1e-3, 1e-2}) {
        for (const double gap : {5e-5, 1e-3, 0.1}) {
            for (int k = 0; k < 20; ++k) {
                NOTE(angle);
                NOTE(gap);
                const Mat3 R = random_rotation(random);
                const Vec3 origin = random_vec3(random);
                const Vec3 da = Vec3::UnitX(),
                           db = random.uniform(0.5, 2.0) * Vec3(std::cos(angle), std::sin(angle), 0);
                const Vec3 center_b(random.uniform(-0.2, 0.2), 0.0, gap);
                const EdgePair e{
                    origin - R * da, origin + R * da, origin + R * (center_b - db), origin + R * (center_b + db)};
                CHECK_NEAR(closest(e).distance(), gap, kClose * gap);
                ++cases_hit;
            }
        }
    }
    CHECK(cases_hit >= 400);
}

TEST(points_on_the_border_of_a_feature_are_told_apart_from_rounding) {
    const std::vector<Vec3> square = {{0, 0, 0}, {0.5, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0}};  // one vertex on a side
    const auto counts = [](const ClosestPoints& found) { return std::pair(found.b.slide_count, found.b.border_count); };
    check::Random random(6);
    for (int k = 0; k < 50; ++k) {
        NOTE(k);
        const Mat3 R = random_rotation(random);
        const Vec3 t = random_vec3(random, 3.0);
        std::vector<Vec3> p;
        for (const Vec3& x : square) p.push_back(R * x + t);
        const auto found = [&](double x, double y, double z) { return closest(R * Vec3(x, y, z) + t, p); };
        CHECK(counts(found(0.3, 0.4, 0.2)) == std::pair(2, 0));
        CHECK(counts(found(0.3, 0.0, 0.2)) == std::pair(2, 1));
        CHECK_NEAR(found(0.3, 0.0, 0.2).b.edge.normalized().cross(R.col(0)), Vec3::Zero(), kRounding);
        CHECK(counts(found(0.5, 0.0, 0.2)) == std::pair(2, 1));  // a vertex there changes nothing
        CHECK(counts(found(1.0, 0.0, 0.2)) == std::pair(2, 2));
        CHECK(counts(found(0.3, -0.2, 0.2)) == std::pair(1, 0));
        CHECK(counts(found(0.5, -0.2, 0.2)) == std::pair(1, 0));
        CHECK(counts(found(1.0, -0.2, 0.2)) == std::pair(1, 1));
        CHECK(counts(found(1.2, 0.0, 0.2)) == std::pair(1, 1));
        CHECK(counts(found(1.2, -0.2, 0.2)) == std::pair(0, 0));
        CHECK_NEAR(found(1.0, 0.0, 0.2).b.point, Vec3(R.col(0) + t), 1e-9);
        const EdgePair crossed{
            R * Vec3(0, 0, 1) + t, R * Vec3(1, 0, 1) + t, R * Vec3(1, -1, 0) + t, R * Vec3(1, 1, 0) + t};
        const ClosestPoints of_edges = closest(crossed);
        CHECK(of_edges.a.slide_count == 1);
        CHECK(of_edges.a.border_count == 1);
        CHECK(of_edges.b.slide_count == 1);
        CHECK(of_edges.b.border_count == 0);
    }
}

}  // namespace test_distance
