#include "geometry/distance.hpp"

#include <Eigen/Geometry>
#include <algorithm>

namespace diffsim {
namespace {

/// Point of a segment nearest to x: its parameter, clamped to [0, 1].
double nearest_parameter(const Vec3& x, const Vec3& p0, const Vec3& direction, double length_sq) {
    if (length_sq == 0.0) return 0.0;
    return std::clamp((x - p0).dot(direction) / length_sq, 0.0, 1.0);
}

bool is_interior(double parameter) { return parameter > 0.0 && parameter < 1.0; }

/// 0 at the first end, 1 at the second, 2 between.
std::uint32_t parameter_code(double parameter) { return parameter <= 0.0 ? 0u : parameter >= 1.0 ? 1u : 2u; }

}  // namespace

Vec3 polygon_normal(const Vec3* vertices, int count) {
    Vec3 area = Vec3::Zero();
    for (int k = 1; k + 1 < count; ++k) area += (vertices[k] - vertices[0]).cross(vertices[k + 1] - vertices[0]);
    const double norm = area.norm();
    return norm > 0.0 ? Vec3(area / norm) : Vec3(Vec3::Zero());
}

ClosestPoints closest_vertex_polygon(const Vec3& x, const PolygonView& polygon) {
    ClosestPoints result;
    result.point_a = x;
    bool inside = !polygon.normal.isZero(0.0);
    const bool has_area = inside;
    double best_sq = kInfinity;
    for (int k = 0; k < polygon.count; ++k) {
        const Vec3& p0 = polygon.vertices[k];
        const int next = k + 1 < polygon.count ? k + 1 : 0;
        const Vec3& p1 = polygon.vertices[next];
        const Vec3 direction = p1 - p0;
        if (has_area && polygon.normal.dot(direction.cross(x - p0)) >= 0.0) continue;
        inside = false;
        const double length_sq = direction.squaredNorm();
        const double parameter = nearest_parameter(x, p0, direction, length_sq);
        const Vec3 point = parameter < 1.0 ? Vec3(p0 + parameter * direction) : p1;
        const double distance_sq = (x - point).squaredNorm();
        if (distance_sq < best_sq) {
            best_sq = distance_sq;
            result.point_b = point;
            result.slide_count_b = is_interior(parameter) ? 1 : 0;
            result.edge_b = direction;
            // A corner is where its edge begins, whichever of its two edges came first by rounding.
            const bool at_end = parameter >= 1.0;
            result.feature_code =
                1u + 3u * static_cast<std::uint32_t>(at_end ? next : k) + (at_end ? 0u : parameter_code(parameter));
        }
    }
    if (inside) {
        const Vec3& n = polygon.normal;
        result.point_b = x - n * n.dot(x - polygon.vertices[0]);
        result.slide_count_b = 2;
        result.feature_code = 0;
    }
    return result;
}

ClosestPoints closest_edge_edge(const Vec3& a0, const Vec3& a1, const Vec3& b0, const Vec3& b1) {
    const Vec3 da = a1 - a0, db = b1 - b0, offset = a0 - b0;
    const double aa = da.squaredNorm(), bb = db.squaredNorm(), ab = da.dot(db);
    // The distance is convex in both parameters: its minimum is a stationary point inside the square,
    // or else at an end of one of the segments. Comparing with the ends keeps nearly parallel edges
    // right, whose stationary point is rounding noise.
    double best_s = 0.0, best_t = 0.0, best_sq = kInfinity;
    const auto consider = [&](double s, double t) {
        const double distance_sq = (offset + s * da - t * db).squaredNorm();
        if (distance_sq < best_sq) {
            best_sq = distance_sq;
            best_s = s;
            best_t = t;
        }
    };
    const double determinant = da.cross(db).squaredNorm();
    if (determinant > 0.0) {
        const double pa = da.dot(offset), pb = db.dot(offset);
        const double s = (ab * pb - bb * pa) / determinant;
        // Between nearly parallel edges s carries much rounding; the t that belongs to it makes that harmless.
        const double t = (pb + s * ab) / bb;
        if (is_interior(s) && is_interior(t)) consider(s, t);
    }
    // Where a stationary point is well determined, it is the answer.
    if (!(best_sq < kInfinity && determinant > 1e-10 * aa * bb)) {
        consider(0.0, nearest_parameter(a0, b0, db, bb));
        consider(1.0, nearest_parameter(a1, b0, db, bb));
        consider(nearest_parameter(b0, a0, da, aa), 0.0);
        consider(nearest_parameter(b1, a0, da, aa), 1.0);
        // Squared distances tie in rounding over sqrt(eps) of a parameter; a projection settles what they cannot.
        best_s = nearest_parameter(b0 + best_t * db, a0, da, aa);
        best_t = nearest_parameter(a0 + best_s * da, b0, db, bb);
    }
    ClosestPoints result;
    result.point_a = a0 + best_s * da;
    result.point_b = b0 + best_t * db;
    result.slide_count_a = is_interior(best_s) ? 1 : 0;
    result.slide_count_b = is_interior(best_t) ? 1 : 0;
    result.edge_a = da;
    result.edge_b = db;
    result.feature_code = 3u * parameter_code(best_s) + parameter_code(best_t);
    return result;
}

}  // namespace diffsim
