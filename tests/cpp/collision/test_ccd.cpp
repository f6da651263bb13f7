#include "collision/ccd.hpp"

#include <algorithm>

#include "ccd_fixtures.hpp"

namespace test_ccd {

using namespace diffsim;
using fixtures::Motion;
using fixtures::random_polygon;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kTolerance = 1e-7;  // [m], given to the CCD: it stops within this above the distance to keep
constexpr double kRounding = 1e-13;  // [m], of coordinates of order 1

CcdOptions keeping(double min_distance) { return {min_distance, kTolerance}; }

/// The same motion seen from elsewhere, from a moving frame, and with its parts named in another order.
std::vector<Motion> variants(const Motion& motion, check::Random& random) {
    std::vector<Motion> result = {motion};
    for (int k = 0; k < 3; ++k) {
        Motion moved = motion;
        const Mat3 R = random_rotation(random);
        const Vec3 shift = random_vec3(random), drift = k == 0 ? Vec3::Zero() : random_vec3(random, 3.0);
        for (Vec3& x : moved.begin) x = R * x + shift;
        for (Vec3& x : moved.end) x = R * x + shift + drift;
        result.push_back(moved);
    }
    const auto reordered = [&](const auto& reorder) {
        Motion other = motion;
        reorder(other.begin);
        reorder(other.end);
        result.push_back(other);
    };
    if (motion.is_edges) {
        reordered([](auto& x) { std::swap(x[0], x[1]); });
        reordered([](auto& x) { std::swap(x[2], x[3]); });
        reordered([](auto& x) { std::swap_ranges(x.begin(), x.begin() + 2, x.begin() + 2); });
    } else {
        reordered([](auto& x) { std::rotate(x.begin() + 1, x.begin() + 2, x.end()); });
        reordered([](auto& x) { std::reverse(x.begin() + 1, x.end()); });
    }
    return result;
}

/// `speed` is how fast the distance falls at the impact.
void check_impact(const Motion& motion, double min_distance, double exact, double speed) {
    check::Random random(11);
    for (const Motion& variant : variants(motion, random)) {
        const double toi = variant.toi(keeping(min_distance));
        CHECK(toi <= exact + kRounding);
        CHECK(toi >= exact - 1.01 * kTolerance / speed);
        CHECK(variant.distance(toi) >= min_distance);
    }
}

void check_miss(const Motion& motion, double min_distance) {
    check::Random random(12);
    for (const Motion& variant : variants(motion, random)) CHECK(variant.toi(keeping(min_distance)) == kNoImpact);
}

/// A vertex against a square of side 2 in the plane z = 0 that stands still.
Motion vertex_over_square(const Vec3& from, const Vec3& to) {
    const Vec3 p0(-1, -1, 0), p1(1, -1, 0), p2(1, 1, 0), p3(-1, 1, 0);
    return {{from, p0, p1, p2, p3}, {to, p0, p1, p2, p3}, false};
}

/// An edge along x against one along y through the origin that stands still.
Motion crossing_edges(double z_begin, double z0_end, double z1_end) {
    const Vec3 b0(0, -1, 0), b1(0, 1, 0);
    return {{{-1, 0, z_begin}, {1, 0, z_begin}, b0, b1}, {{-1, 0, z0_end}, {1, 0, z1_end}, b0, b1}, true};
}

}  // namespace

TEST(vertex_hits_face_edge_and_corner_in_time) {
    for (const double keep : {0.0, 1e-3, 0.1}) {
        NOTE(keep);
        check_impact(vertex_over_square({0.3, 0.2, 1}, {0.3, 0.2, -1}), keep, 0.5 * (1.0 - keep), 2.0);
        check_impact(vertex_over_square({0.3, 0.2, -1}, {0.3, 0.2, 3}), keep, 0.25 * (1.0 - keep), 4.0);
        check_impact(vertex_over_square({3, 0.2, 0}, {-1, 0.2, 0}), keep, 0.25 * (2.0 - keep), 4.0);
        const double along = std::sqrt(2.0);  // straight at the corner (1, 1)
        check_impact(
            vertex_over_square({3, 3, 0}, {-1, -1, 0}), keep, (2.0 * along - keep) / (4.0 * along), 4.0 * along);
        // Skimming down a slope onto the face: only the normal part of the motion closes in.
        check_impact(vertex_over_square({-0.9, 0, 0.5}, {0.9, 0, -0.5}), keep, 0.5 - keep, 1.0);
    }
}

TEST(edges_meet_in_time) {
    for (const double keep : {0.0, 1e-3, 0.1}) {
        NOTE(keep);
        check_impact(crossing_edges(1, -1, -1), keep, 0.5 * (1.0 - keep), 2.0);
        const Vec3 b0(2, -1, 0), b1(2, 1, 0);  // end of one against the inside of the other
        check_impact(
            {{{-1, 0, 0}, {1, 0, 0}, b0, b1}, {{1, 0, 0}, {3, 0, 0}, b0, b1}, true}, keep, 0.5 * (1.0 - keep), 2.0);
        const Vec3 c0(-1, 0, 1), c1(3, 0, 1);  // parallel
        check_impact(
            {{{-1, 0, 0}, {1, 0, 0}, c0, c1}, {{-1, 0, 2}, {1, 0, 2}, c0, c1}, true}, keep, 0.5 * (1.0 - keep), 2.0);
    }
    // One end falls by 4, the other stays: the middle is at 1 - 2s, seen at the slope of 45° the edge then has.
    check_impact(crossing_edges(1, -3, 1), 0.0, 0.5, 2.0 / std::sqrt(2.0));
}

TEST(a_growing_and_turning_triangle_meets_a_vertex) {
    // Corner k of the triangle falls from z = 1 to z_k: over the vertex at the origin, the centroid, it is their mean.
    const Vec3 x = Vec3::Zero(), p0(2, 0, 1), p1(-1, 1, 1), p2(-1, -1, 1);
    const Motion motion{{x, p0, p1, p2}, {x, {2, 0, -3}, {-1, 1, 1}, {-1, -1, -1}}, false};
    const double exact = 0.5;  // mean of z at the end is -1
    check::Random random(13);
    for (const Motion& variant : variants(motion, random)) {
        const double toi = variant.toi(keeping(0.0));
        CHECK(toi <= exact + kRounding);
        CHECK(toi >= exact - 10.0 * kTolerance);  // the face is inclined: its distance falls slower than its height
    }
}

TEST(misses_are_misses) {
    for (const double keep : {0.0, 0.1}) {
        NOTE(keep);
        check_miss(vertex_over_square({0.3, 0.2, 1}, {0.3, 0.2, 2}), keep);      // leaving
        check_miss(vertex_over_square({0.3, 0.2, 1}, {0.3, 0.2, 0.2}), keep);    // stopping short
        check_miss(vertex_over_square({1.2, 0, 1}, {1.2, 0, -1}), keep);         // past the edge
        check_miss(vertex_over_square({0.3, 0.2, 0.2}, {0.3, 0.2, 0.2}), keep);  // standing still
        check_miss(crossing_edges(1, 0.2, 0.2), keep);
        check_miss(
            {{{-1, 0, 1}, {1, 0, 1}, {1.2, -1, 0}, {1.2, 1, 0}},
             {{-1, 0, -1}, {1, 0, -1}, {1.2, -1, 0}, {1.2, 1, 0}},
             true},
            keep);
    }
}

TEST(grazing_is_decided_by_the_distance_to_keep) {
    constexpr double kKeep = 0.1, kSide = 1e-4;
    for (const double edge_distance : {kKeep + kSide, kKeep - kSide}) {
        const Motion past = vertex_over_square({1.0 + edge_distance, 0, 1}, {1.0 + edge_distance, 0, -1});
        const Motion over = vertex_over_square({-5, 0, edge_distance}, {5, 0, edge_distance});
        check::Random random(14);
        for (const Motion& motion : {past, over}) {
            for (const Motion& variant : variants(motion, random)) {
                const double toi = variant.toi(keeping(kKeep));
                CHECK((toi == kNoImpact) == (edge_distance > kKeep));
                if (toi != kNoImpact) CHECK(variant.distance(toi) <= kKeep + kTolerance);
            }
        }
    }
}

TEST(sliding_along_a_face_takes_one_look) {
    CcdOptions options = keeping(1e-3);
    options.max_iterations = 1;
    CHECK(vertex_over_square({-0.9, 0, 2e-3}, {0.9, 0.3, 2e-3}).toi(options) == kNoImpact);
    CHECK(vertex_over_square({-0.9, 0, 2e-3}, {40, 0.3, 2e-3}).toi(options) == kNoImpact);
    CHECK(crossing_edges(2e-3, 2e-3, 2e-3).toi(options) == kNoImpact);
}

TEST(a_start_too_close_goes_nowhere) {
    CHECK(vertex_over_square({0, 0, 0.05}, {0, 0, 1}).toi(keeping(0.1)) == 0.0);
    CHECK(crossing_edges(0.05, 1, 1).toi(keeping(0.1)) == 0.0);
    CHECK(plane_toi(0.05, 1.0, keeping(0.1)) == 0.0);
}

TEST(planes_are_met_in_time) {
    for (const double keep : {0.0, 1e-3, 0.1}) {
        const double toi = plane_toi(1.0, -1.0, keeping(keep)), exact = 0.5 * (1.0 - keep);
        CHECK(toi <= exact);
        CHECK(toi >= exact - kTolerance);
        CHECK(plane_toi(1.0, 0.2, keeping(keep)) == kNoImpact);
        CHECK(plane_toi(1.0, 3.0, keeping(keep)) == kNoImpact);
        CcdOptions part = keeping(keep);
        part.until = 0.6;
        CHECK(plane_toi(1.0, -1.0, part) == toi);
        part.until = 0.4;
        CHECK(plane_toi(1.0, -1.0, part) == kNoImpact);
    }
}

TEST(random_motions_are_safe_up_to_the_impact_and_close_at_it) {
    check::Random random(15);
    int impacts = 0, misses = 0;
    constexpr int kSamples = 100;
    for (int k = 0; k < 400; ++k) {
        NOTE(k);
        Motion motion;
        motion.is_edges = k % 2 == 0;
        if (motion.is_edges) {
            for (int i = 0; i < 4; ++i) motion.begin.push_back(random_vec3(random));
        } else {
            motion.begin = random_polygon(random, k % 20 == 1 ? 20 : 3);  // more corners than the stack holds, too
            motion.begin.insert(motion.begin.begin(), random_vec3(random, 2.0));
        }
        // Vertices of one feature move as one affine map takes them, so that a polygon stays flat.
        const Mat3 map_a = Mat3::Identity() + random.matrix(3, 3), map_b = Mat3::Identity() + random.matrix(3, 3);
        const std::size_t split = motion.is_edges ? 2 : 1;
        const Vec3 approach = 2.0 * (motion.begin[split] - motion.begin[0]);
        for (std::size_t i = 0; i < motion.begin.size(); ++i)
            motion.end.push_back(i < split ? Vec3(map_a * motion.begin[i] + approach) : Vec3(map_b * motion.begin[i]));
        const double keep = k % 3 == 0 ? 0.0 : random.uniform(0.0, 0.2);
        if (motion.distance(0.0) <= keep + kTolerance) continue;

        const double toi = motion.toi(keeping(keep)), until = std::min(toi, 1.0);
        for (int s = 0; s <= kSamples; ++s) CHECK(motion.distance(until * s / kSamples) >= keep - kRounding);
        // Looked for up to some time only, the same impact is found if it is before that.
        CcdOptions part = keeping(keep);
        part.until = random.uniform(0.0, 1.0);
        const double early = motion.toi(part);
        CHECK((early == toi || early == kNoImpact));
        if (toi < part.until) CHECK(early == toi);
        if (toi > part.until + kTolerance) CHECK(early == kNoImpact);
        if (toi == kNoImpact) {
            ++misses;
            continue;
        }
        ++impacts;
        CHECK(toi > 0.0);
        CHECK(motion.distance(toi) <= keep + 1.001 * kTolerance);
    }
    CHECK(impacts >= 50);
    CHECK(misses >= 50);
}

}  // namespace test_ccd
