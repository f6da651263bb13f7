#include "collision/ccd.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <vector>

#include "geometry/distance.hpp"
#include "math/bernstein.hpp"

namespace diffsim {
namespace {

/// Polygons up to this many corners need no heap.
constexpr int kSmallPolygon = 16;
constexpr int kFixedAdvances = 2;     // before planes turn: most pairs need no more
constexpr double kShortReach = 0.25;  // of a span: the next one is shorter
constexpr double kSpanFactor = 4.0;
constexpr double kRoundings = 16.0;  // in units of kEpsilon: of a position, and of a coefficient of a polynomial

template <std::size_t N>
using Scalars = std::array<double, N>;
template <std::size_t N>
using Vectors = std::array<Vec3, N>;

double dot(const Vec3& a, const Vec3& b) { return a.dot(b); }
double multiply(double a, double b) { return a * b; }
Vec3 cross(const Vec3& a, const Vec3& b) { return a.cross(b); }
Vec3 scale(const Vec3& a, double b) { return b * a; }

/// A vertex on its straight line. Positions and velocities are relative to those of the pair's first vertex, so that
/// rounding does not grow with the distance from the origin, nor with the motion that the features share.
struct Line {
    Vec3 start, velocity;

    Vec3 at(double time) const { return start + time * velocity; }
    Vectors<2> over(double begin, double end) const { return {at(begin), at(end)}; }
};

Vectors<2> difference(const Vectors<2>& a, const Vectors<2>& b) { return {Vec3(a[0] - b[0]), Vec3(a[1] - b[1])}; }

/// Two convex features, each the hull of moving vertices.
struct Features {
    const Line *a, *b;
    int count_a, count_b;
    double extent;  ///< bound on the coordinates of all vertices, relative to the first
};

/// How long from `time` on the plane with the fixed normal n keeps the features this far apart, or infinity if until
/// the time `until` at least; exact.
double fixed_reach(const Features& features, const Vec3& n, double time, double until, double keep) {
    double reach = kInfinity;
    for (int i = 0; i < features.count_a; ++i) {
        const double velocity_a = n.dot(features.a[i].velocity);
        const double room_a = n.dot(features.a[i].start) + time * velocity_a - keep;
        for (int j = 0; j < features.count_b; ++j) {
            const double velocity_b = n.dot(features.b[j].velocity);
            const double room = room_a - (n.dot(features.b[j].start) + time * velocity_b);
            if (!(room > 0.0)) return 0.0;
            const double speed = velocity_b - velocity_a;
            if (speed * (until - time) > room) reach = std::min(reach, room / speed);
        }
    }
    return reach;
}

/// The part of [begin, end] for which the planes with the turning normal n keep the features this far apart:
/// n · (a - b) >= keep |n| for all vertices a, b. For any length l > 0, |n| <= (n² + l²) / 2l, all but equal where l is
/// near |n|: l interpolates between the ends. So 2 l n · (a - b) >= keep (n² + l²) is enough, between polynomials.
template <std::size_t N>
double turning_reach(
    const Features& features, Vectors<N> n, const Vec3& offset, double begin, double end, double keep) {
    if (n[0].dot(offset) < 0.0)
        for (Vec3& coefficient : n) coefficient = -coefficient;
    const Scalars<2> length{n[0].norm(), n[N - 1].norm()};
    if (!(length[0] > 0.0 && length[1] > 0.0)) return 0.0;
    constexpr std::size_t M = std::max(2 * N - 1, N + 2);
    Scalars<M> bound = raised<M>(bernstein_product(n, n, dot));
    const Scalars<M> length_sq = raised<M>(bernstein_product(length, length, multiply));
    for (std::size_t k = 0; k < M; ++k) bound[k] = keep * (bound[k] + length_sq[k]);
    Vectors<N + 1> weighted = bernstein_product(n, length, scale);
    double largest = 0.0;
    for (Vec3& coefficient : weighted) {
        coefficient *= 2.0;
        largest = std::max(largest, coefficient.lpNorm<1>());
    }
    // Where n is much shorter than its coefficients, their rounding is all there is.
    const double rounding =
        kRoundings * kEpsilon * (largest * features.extent + *std::max_element(bound.begin(), bound.end()));
    for (double& coefficient : bound) coefficient += rounding;
    double reach = 1.0;
    for (int i = 0; i < features.count_a; ++i) {
        const Vectors<2> a = features.a[i].over(begin, end);
        for (int j = 0; j < features.count_b; ++j) {
            const Vectors<2> offsets = difference(a, features.b[j].over(begin, end));
            Scalars<M> room = raised<M>(bernstein_product(weighted, offsets, dot));
            for (std::size_t k = 0; k < M; ++k) room[k] -= bound[k];
            reach = std::min(reach, positive_until(room));
            if (reach == 0.0) return 0.0;
        }
    }
    return reach;
}

/// From an edge with this direction to a vertex at this offset from its first end, square to the edge.
Vectors<4> edge_normal(const Vectors<2>& direction, const Vectors<2>& offset) {
    const Vectors<4> along = bernstein_product(direction, bernstein_product(direction, offset, dot), scale);
    Vectors<4> normal = bernstein_product(offset, bernstein_product(direction, direction, dot), scale);
    for (std::size_t k = 0; k < normal.size(); ++k) normal[k] -= along[k];
    return normal;
}

/// A vertex against a polygon, and what of it is closest.
struct VertexPolygon {
    Features features;
    Vec3* corners;  // at some time

    ClosestPoints closest(double time) const {
        const int count = features.count_b;
        for (int k = 0; k < count; ++k) corners[k] = features.b[k].at(time);
        return closest_vertex_polygon(features.a->at(time), {corners, count, polygon_normal(corners, count)});
    }

    double turning_reach(const ClosestPoints& points, const Vec3& offset, double begin, double end, double keep) const {
        const Line* corner = features.b;
        const Vectors<2> vertex = features.a->over(begin, end);
        if (points.b.slide_count == 2) {
            Vectors<3> normal{Vec3::Zero(), Vec3::Zero(), Vec3::Zero()};
            const Vectors<2> first = corner[0].over(begin, end);
            for (int k = 1; k + 1 < features.count_b; ++k) {
                const Vectors<3> area = bernstein_product(
                    difference(corner[k].over(begin, end), first), difference(corner[k + 1].over(begin, end), first),
                    cross);
                for (std::size_t i = 0; i < area.size(); ++i) normal[i] += area[i];
            }
            return diffsim::turning_reach(features, normal, offset, begin, end, keep);
        }
        const int k = static_cast<int>(points.feature_code - 1) / 3;
        const Vectors<2> nearest = corner[k].over(begin, end), from_nearest = difference(vertex, nearest);
        if (points.b.slide_count == 0) return diffsim::turning_reach(features, from_nearest, offset, begin, end, keep);
        const Vectors<2> next = corner[k + 1 < features.count_b ? k + 1 : 0].over(begin, end);
        return diffsim::turning_reach(
            features, edge_normal(difference(next, nearest), from_nearest), offset, begin, end, keep);
    }
};

/// Two edges, and what of them is closest.
struct EdgeEdge {
    Features features;

    ClosestPoints closest(double time) const {
        const Line *a = features.a, *b = features.b;
        return closest_edge_edge(a[0].at(time), a[1].at(time), b[0].at(time), b[1].at(time));
    }

    double turning_reach(const ClosestPoints& points, const Vec3& offset, double begin, double end, double keep) const {
        const Line *a = features.a, *b = features.b;
        const Vectors<2> a0 = a[0].over(begin, end), a1 = a[1].over(begin, end);
        const Vectors<2> b0 = b[0].over(begin, end), b1 = b[1].over(begin, end);
        const Vectors<2> edge_a = difference(a1, a0), edge_b = difference(b1, b0);
        // A point on the border of its edge is an end: there edges may be as good as parallel, without a common normal.
        const bool inside_a = points.a.slide_count > points.a.border_count;
        const bool inside_b = points.b.slide_count > points.b.border_count;
        if (inside_a && inside_b)
            return diffsim::turning_reach(features, bernstein_product(edge_a, edge_b, cross), offset, begin, end, keep);
        const auto is_first = [](const Vec3& point, const Vectors<2>& first, const Vectors<2>& second) {
            return (point - first[0]).squaredNorm() < (point - second[0]).squaredNorm();
        };
        const Vectors<2>& end_a = is_first(points.a.point, a0, a1) ? a0 : a1;
        const Vectors<2>& end_b = is_first(points.b.point, b0, b1) ? b0 : b1;
        if (inside_a)
            return diffsim::turning_reach(
                features, edge_normal(edge_a, difference(end_b, a0)), offset, begin, end, keep);
        if (inside_b)
            return diffsim::turning_reach(
                features, edge_normal(edge_b, difference(end_a, b0)), offset, begin, end, keep);
        return diffsim::turning_reach(features, difference(end_a, end_b), offset, begin, end, keep);
    }
};

/// From the middle of b's vertices to that of a's at the start.
Vec3 middle_offset(const Features& features) {
    Vec3 a = Vec3::Zero(), b = Vec3::Zero();
    for (int i = 0; i < features.count_a; ++i) a += features.a[i].start;
    for (int j = 0; j < features.count_b; ++j) b += features.b[j].start;
    return (1.0 / features.count_a) * a - (1.0 / features.count_b) * b;
}

/// The common loop. The times it visits do not depend on `until`, so that one impact has one time, whoever asks.
template <typename Pair>
CcdResult advance(const Pair& pair, const CcdOptions& options) {
    // Aim half a tolerance above the minimum, so that rounding cannot carry us below it.
    const double rounding = kRoundings * kEpsilon * pair.features.extent;
    const double keep = options.min_distance + std::max(0.5 * options.tolerance, rounding);
    const double near = options.min_distance + std::max(options.tolerance, 2.0 * rounding);
    // Between small features far from each other any plane does: most pairs that meshes list need no closest points.
    const Vec3 middles = middle_offset(pair.features);
    const double apart = middles.norm();
    if (apart > near && fixed_reach(pair.features, (1.0 / apart) * middles, 0.0, options.until, keep) == kInfinity)
        return {kNoImpact, 0};
    double time = 0.0, span = 1.0;
    for (int k = 0; k < options.max_iterations; ++k) {
        const ClosestPoints points = pair.closest(time);
        const Vec3 offset = points.a.point - points.b.point;
        const double distance = offset.norm();
        if (!(distance > near)) return {time, k};
        double next = time + fixed_reach(pair.features, (1.0 / distance) * offset, time, options.until, keep);
        // Where features nearly touch, their offset is mostly rounding: the plane across it may not separate them.
        if (next < options.until && (k >= kFixedAdvances || !(next > time))) {
            const double end = std::min(time + span, 1.0);
            const double part = pair.turning_reach(points, offset, time, end, keep);
            next = std::max(next, part < 1.0 ? time + part * (end - time) : end);
            if (part == 1.0)
                span *= kSpanFactor;
            else if (part < kShortReach)
                span = std::max((end - time) / kSpanFactor, next - time);
        }
        if (next >= options.until) return {kNoImpact, k + 1};
        if (!(next > time)) return {time, k + 1};
        time = next;
    }
    return {time, options.max_iterations};
}

Line relative_line(const Vec3& begin, const Vec3& end, const Vec3& origin_begin, const Vec3& origin_end) {
    const Vec3 start = begin - origin_begin;
    return {start, (end - origin_end) - start};
}

/// Bound on the line's coordinates on the way.
Vec3 extent(const Line& line) { return line.start.cwiseAbs() + line.velocity.cwiseAbs(); }

}  // namespace

CcdResult vertex_polygon_ccd(
    const Vec3& x0, const Vec3& x1, const Vec3* p0, const Vec3* p1, int count, const CcdOptions& options) {
    struct Corners {
        std::array<Line, kSmallPolygon> lines;
        std::array<Vec3, kSmallPolygon> points;
    };
    Corners small;
    std::vector<Line> large_lines;
    std::vector<Vec3> large_points;
    const bool is_large = count > kSmallPolygon;
    if (is_large) {
        large_lines.resize(static_cast<std::size_t>(count));
        large_points.resize(static_cast<std::size_t>(count));
    }
    Line* lines = is_large ? large_lines.data() : small.lines.data();
    Vec3 size = Vec3::Zero();
    for (int k = 0; k < count; ++k) {
        lines[k] = relative_line(p0[k], p1[k], x0, x1);
        size = size.cwiseMax(extent(lines[k]));
    }
    const Line vertex{Vec3::Zero(), Vec3::Zero()};
    const Features features{&vertex, lines, 1, count, size.maxCoeff()};
    return advance(VertexPolygon{features, is_large ? large_points.data() : small.points.data()}, options);
}

CcdResult edge_edge_ccd(
    const Vec3 a0[2], const Vec3 a1[2], const Vec3 b0[2], const Vec3 b1[2], const CcdOptions& options) {
    const Line a[2] = {{Vec3::Zero(), Vec3::Zero()}, relative_line(a0[1], a1[1], a0[0], a1[0])};
    const Line b[2] = {relative_line(b0[0], b1[0], a0[0], a1[0]), relative_line(b0[1], b1[1], a0[0], a1[0])};
    const double size = extent(a[1]).cwiseMax(extent(b[0])).cwiseMax(extent(b[1])).maxCoeff();
    return advance(EdgeEdge{{a, b, 2, 2, size}}, options);
}

double plane_toi(double distance0, double distance1, const CcdOptions& options) {
    if (!(distance0 > options.min_distance + options.tolerance)) return 0.0;
    const double room = distance0 - options.min_distance - 0.5 * options.tolerance;
    return options.until * (distance0 - distance1) <= room ? kNoImpact : room / (distance0 - distance1);
}

}  // namespace diffsim
