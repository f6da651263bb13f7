#pragma once

#include <cstdint>

#include "math/types.hpp"

/// Distances between convex features, typed: which vertex, edge or face interior holds the closest
/// points decides how they slide when the features move, and so the second derivative.
namespace diffsim {

/// One of two closest points, and along which directions it may slide on its feature.
struct ClosestPoint {
    Vec3 point;
    int slide_count = 0;  ///< 0 at a vertex, 1 on an edge, 2 inside a face
    /// How many of these directions the point can follow one way alone, because up to rounding it is on the border of
    /// its feature: what would move it the other way leaves it there.
    int border_count = 0;
    /// The edge from its first end to its second, where the count is 1 or the point is on the border of a face; of two
    /// edges always.
    Vec3 edge;
    /// Where it is on its feature. Of an edge: 0 at its first end, 1 at its second, 2 between. Of a polygon: 0 inside,
    /// else 1 + 3 k at corner k, 2 more on the edge that begins there.
    std::uint32_t code = 0;
};

/// The closest points of features a and b.
struct ClosestPoints {
    ClosestPoint a, b;
    std::uint32_t feature_code = 0;  ///< tells the type and the sub-features apart, for signatures

    double distance() const { return (a.point - b.point).norm(); }
};

/// A planar convex polygon in space.
struct PolygonView {
    const Vec3* vertices;
    int count;
    Vec3 normal;  ///< unit; zero for a polygon without area, which is then treated as its boundary
};

/// Area-weighted normal of a polygon, unit length, or zero when its area vanishes.
Vec3 polygon_normal(const Vec3* vertices, int count);

/// Vertex x (feature a) against a convex polygon (feature b).
ClosestPoints closest_vertex_polygon(const Vec3& x, const PolygonView& polygon);

/// Segment a0-a1 (feature a) against segment b0-b1 (feature b).
ClosestPoints closest_edge_edge(const Vec3& a0, const Vec3& a1, const Vec3& b0, const Vec3& b1);

}  // namespace diffsim
