#include "collision/ccd.hpp"

#include <algorithm>
#include <array>
#include <vector>

#include "geometry/distance.hpp"

namespace diffsim {
namespace {

/// Polygons up to this many corners need no heap.
constexpr int kSmallPolygon = 16;

/// The common loop. `closest(s)` gives the closest points at time s; `closing_speed(n)` how fast the
/// features can close in along the direction n from b to a.
template <typename Closest, typename ClosingSpeed>
double advance(const Closest& closest, const ClosingSpeed& closing_speed, const CcdOptions& options) {
    double time = 0.0;
    for (int k = 0; k < options.max_iterations; ++k) {
        const ClosestPoints points = closest(time);
        const Vec3 offset = points.point_a - points.point_b;
        const double distance = offset.norm();
        if (!(distance > options.min_distance + options.tolerance)) return time;
        const double speed = closing_speed(Vec3(offset / distance));
        // Aim half a tolerance above the minimum, so that rounding cannot carry us below it.
        const double room = distance - options.min_distance - 0.5 * options.tolerance;
        if (speed * (options.until - time) <= room) return kNoImpact;
        time += room / speed;
    }
    return time;
}

}  // namespace

double vertex_polygon_toi(
    const Vec3& x0, const Vec3& x1, const Vec3* p0, const Vec3* p1, int count, const CcdOptions& options) {
    std::array<Vec3, kSmallPolygon> small;
    std::vector<Vec3> large;
    if (count > kSmallPolygon) large.resize(static_cast<std::size_t>(count));
    Vec3* corners = count > kSmallPolygon ? large.data() : small.data();
    const Vec3 motion = x1 - x0;
    const auto closest = [&](double s) {
        for (int k = 0; k < count; ++k) corners[k] = p0[k] + s * (p1[k] - p0[k]);
        return closest_vertex_polygon(x0 + s * motion, {corners, count, polygon_normal(corners, count)});
    };
    const auto closing_speed = [&](const Vec3& n) {
        double speed = -kInfinity;
        for (int k = 0; k < count; ++k) speed = std::max(speed, n.dot(p1[k] - p0[k]));
        return speed - n.dot(motion);
    };
    return advance(closest, closing_speed, options);
}

double edge_edge_toi(
    const Vec3 a0[2], const Vec3 a1[2], const Vec3 b0[2], const Vec3 b1[2], const CcdOptions& options) {
    const Vec3 va[2] = {a1[0] - a0[0], a1[1] - a0[1]};
    const Vec3 vb[2] = {b1[0] - b0[0], b1[1] - b0[1]};
    const auto closest = [&](double s) {
        return closest_edge_edge(a0[0] + s * va[0], a0[1] + s * va[1], b0[0] + s * vb[0], b0[1] + s * vb[1]);
    };
    const auto closing_speed = [&](const Vec3& n) {
        return std::max(n.dot(vb[0]), n.dot(vb[1])) - std::min(n.dot(va[0]), n.dot(va[1]));
    };
    return advance(closest, closing_speed, options);
}

double plane_toi(double distance0, double distance1, const CcdOptions& options) {
    if (!(distance0 > options.min_distance + options.tolerance)) return 0.0;
    const double room = distance0 - options.min_distance - 0.5 * options.tolerance;
    return options.until * (distance0 - distance1) <= room ? kNoImpact : room / (distance0 - distance1);
}

}  // namespace diffsim
