#pragma once

#include "math/types.hpp"

/// Conservative continuous collision detection between features whose vertices move on straight lines.
///
/// Where a plane keeps two convex features apart, they do not meet. Each advance takes the plane normal to the offset
/// of the closest points and goes on for as long as it separates all vertices by the distance to keep: with its
/// direction fixed first, which is enough for whatever slides, falls or flies past, then with the direction turning as
/// the features do. The normal of a face, of two edges, or from an edge to a vertex is a polynomial in time, and so are
/// the distances of all vertices along it: bounds of polynomials say how long the plane separates. The cost grows with
/// the logarithm of motion over tolerance. No roots of cubics, nothing to misjudge when they are nearly multiple, and
/// nothing rests on how well closest points are found: what a plane separates is tested for every vertex.
namespace diffsim {

struct CcdOptions {
    double min_distance = 0.0;  ///< distance to keep [m]
    double tolerance = 0.0;     ///< stop once within this of min_distance, from above [m]; must be positive
    int max_iterations = 200;   ///< a time reached by then is still safe, only early
    double until = 1.0;         ///< impacts at this time and later do not matter
};

inline constexpr double kNoImpact = kInfinity;

struct CcdResult {
    double toi;      ///< a time in [0, until) up to which min_distance is kept, or kNoImpact if it is all the way
    int iterations;  ///< advances that took
};

/// A vertex going from x0 to x1 against the convex polygon going from p0 to p1. The time is 0 if it starts too close.
CcdResult vertex_polygon_ccd(
    const Vec3& x0, const Vec3& x1, const Vec3* p0, const Vec3* p1, int count, const CcdOptions& options);

/// The same for two segments, each given by its two ends at the start and at the end of the motion.
CcdResult edge_edge_ccd(
    const Vec3 a0[2], const Vec3 a1[2], const Vec3 b0[2], const Vec3 b1[2], const CcdOptions& options);

/// The time alone, for a vertex at a signed distance above a plane.
double plane_toi(double distance0, double distance1, const CcdOptions& options);

}  // namespace diffsim
