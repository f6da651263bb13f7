#include "geometry/distance.hpp"

#include <Eigen/Geometry>
#include <algorithm>

namespace diffsim {
namespace {

/// Nearer than this to its end, by its length, a point is at the end of an edge and free to leave it: rounding would
/// say anything, and differences tell no two such points apart.
constexpr double kBorder = 1e-10;

/// Where on a segment a point is nearest to x.
struct OnSegment {
    double parameter;        ///< in [0, 1]
    bool slides = false;     ///< the nearest point of the whole line is on the segment
    bool is_border = false;  ///< and is an end of it, up to rounding

    /// 0 at the first end, 1 at the second, 2 where it slides.
    std::uint32_t code() const { return slides ? 2u : parameter <= 0.0 ? 0u : 1u; }
};

OnSegment nearest_on_segment(const Vec3& x, const Vec3& p0, const Vec3& direction, double length_sq) {
    if (length_sq == 0.0) return {0.0};
    const double free = (x - p0).dot(direction) / length_sq;
    if (std::abs(free) <= kBorder) return {0.0, true, true};
    if (std::abs(free - 1.0) <= kBorder) return {1.0, true, true};
    return {std::clamp(free, 0.0, 1.0), free > 0.0 && free < 1.0};
}

/// Whether two edges that follow each other are one: the vertex between them ends no slide.
bool is_straight(const Vec3& edge, const Vec3& next) {
    const double limit_sq = kBorder * kBorder * edge.squaredNorm() * next.squaredNorm();
    return edge.dot(next) > 0.0 && edge.cross(next).squaredNorm() <= limit_sq;
}

/// Edge k of a polygon, from vertex k to the next; k from -1 to the number of edges.
Vec3 edge_of(const PolygonView& polygon, int k) {
    const int first = k < 0 ? polygon.count - 1 : k < polygon.count ? k : 0;
    return polygon.vertices[first + 1 < polygon.count ? first + 1 : 0] - polygon.vertices[first];
}

}  // namespace

Vec3 polygon_normal(const Vec3* vertices, int count) {
    Vec3 area = Vec3::Zero();
    for (int k = 1; k + 1 < count; ++k) area += (vertices[k] - vertices[0]).cross(vertices[k + 1] - vertices[0]);
    const double norm = area.norm();
    return norm > 0.0 ? Vec3(area / norm) : Vec3(Vec3::Zero());
}

ClosestPoints closest_vertex_polygon(const Vec3& x, const PolygonView& polygon) {
    ClosestPoints result;
    result.a.point = x;
    bool inside = !polygon.normal.isZero(0.0);
    const bool has_area = inside;
    int borders = 0;  // that x is above
    double best_sq = kInfinity;
    for (int k = 0; k < polygon.count; ++k) {
        const Vec3& p0 = polygon.vertices[k];
        const int next = k + 1 < polygon.count ? k + 1 : 0;
        const Vec3& p1 = polygon.vertices[next];
        const Vec3 direction = p1 - p0;
        const double length_sq = direction.squaredNorm();
        const double inward = has_area ? polygon.normal.dot(direction.cross(x - p0)) : -kInfinity;
        if (inward > kBorder * length_sq) continue;
        OnSegment at = nearest_on_segment(x, p0, direction, length_sq);
        if (inward >= -kBorder * length_sq) {
            const bool is_new =
                borders == 0 || !(is_straight(result.b.edge, direction) || is_straight(direction, result.b.edge));
            if (!inside || !at.slides || !is_new) continue;
            result.b.edge = direction;
            ++borders;
            continue;
        }
        inside = false;
        if (at.is_border && has_area)
            at.is_border = at.parameter > 0.0 ? !is_straight(direction, edge_of(polygon, k + 1))
                                              : !is_straight(edge_of(polygon, k - 1), direction);
        const Vec3 point = at.parameter < 1.0 ? Vec3(p0 + at.parameter * direction) : p1;
        const double distance_sq = (x - point).squaredNorm();
        // A corner may be as near as the end of one of its edges that the point could slide along.
        if (distance_sq < best_sq || (distance_sq == best_sq && at.is_border && result.b.border_count == 0)) {
            best_sq = distance_sq;
            result.b.point = point;
            result.b.slide_count = at.slides ? 1 : 0;
            result.b.border_count = at.is_border ? 1 : 0;
            result.b.edge = direction;
            // A corner is where its edge begins, whichever of its two edges came first by rounding.
            const bool at_end = at.code() == 1u;
            result.b.code = 1u + 3u * static_cast<std::uint32_t>(at_end ? next : k) + (at_end ? 0u : at.code());
        }
    }
    if (inside) {
        const Vec3& n = polygon.normal;
        result.b.point = x - n * n.dot(x - polygon.vertices[0]);
        result.b.slide_count = 2;
        result.b.border_count = std::min(borders, 2);
        result.b.code = 0;
    }
    result.feature_code = result.b.code;
    return result;
}

ClosestPoints closest_edge_edge(const Vec3& a0, const Vec3& a1, const Vec3& b0, const Vec3& b1) {
    const Vec3 da = a1 - a0, db = b1 - b0, offset = a0 - b0;
    const double aa = da.squaredNorm(), bb = db.squaredNorm(), ab = da.dot(db);
    // The distance is convex in both parameters: its minimum is a stationary point inside the square,
    // or else at an end of one of the segments. Comparing with the ends keeps nearly parallel edges
    // right, whose stationary point is rounding noise.
    OnSegment best_s{0.0}, best_t{0.0};
    double best_sq = kInfinity;
    const auto consider = [&](OnSegment s, OnSegment t) {
        const double distance_sq = (offset + s.parameter * da - t.parameter * db).squaredNorm();
        if (distance_sq < best_sq) {
            best_sq = distance_sq;
            best_s = s;
            best_t = t;
        }
    };
    const auto is_inside = [](double parameter) { return parameter > kBorder && parameter < 1.0 - kBorder; };
    const double determinant = da.cross(db).squaredNorm();
    if (determinant > 0.0) {
        const double pa = da.dot(offset), pb = db.dot(offset);
        const double s = (ab * pb - bb * pa) / determinant;
        // Between nearly parallel edges s carries much rounding; the t that belongs to it makes that harmless.
        const double t = (pb + s * ab) / bb;
        if (is_inside(s) && is_inside(t)) consider({s, true}, {t, true});
    }
    // Where a stationary point is well determined, it is the answer.
    if (!(best_sq < kInfinity && determinant > 1e-10 * aa * bb)) {
        consider({0.0}, nearest_on_segment(a0, b0, db, bb));
        consider({1.0}, nearest_on_segment(a1, b0, db, bb));
        consider(nearest_on_segment(b0, a0, da, aa), {0.0});
        consider(nearest_on_segment(b1, a0, da, aa), {1.0});
        // Squared distances tie in rounding over sqrt(eps) of a parameter; a projection settles what they cannot.
        best_s = nearest_on_segment(b0 + best_t.parameter * db, a0, da, aa);
        best_t = nearest_on_segment(a0 + best_s.parameter * da, b0, db, bb);
    }
    ClosestPoints result;
    result.a.point = a0 + best_s.parameter * da;
    result.b.point = b0 + best_t.parameter * db;
    result.a.slide_count = best_s.slides ? 1 : 0;
    result.b.slide_count = best_t.slides ? 1 : 0;
    result.a.border_count = best_s.is_border ? 1 : 0;
    result.b.border_count = best_t.is_border ? 1 : 0;
    result.a.edge = da;
    result.b.edge = db;
    result.a.code = best_s.code();
    result.b.code = best_t.code();
    result.feature_code = 3u * result.a.code + result.b.code;
    return result;
}

}  // namespace diffsim
