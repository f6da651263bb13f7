#pragma once

#include "math/types.hpp"

/// Conservative continuous collision detection between features whose vertices move on straight lines.
///
/// Conservative advancement: the plane through the closest points, normal to their offset, separates two
/// convex features. If the vertices close in on it at speed mu, the distance d cannot fall below a
/// minimum before the time (d - minimum) / mu; advance by that and look again. Sliding along a face has
/// mu = 0 and costs one look. No roots of cubics, nothing to misjudge when they are nearly multiple.
namespace diffsim {

struct CcdOptions {
    double min_distance = 0.0;  ///< distance to keep [m]
    double tolerance = 0.0;     ///< stop once within this of min_distance, from above [m]; must be positive
    int max_iterations = 1000;  ///< a time reached by then is still safe, only early
    double until = 1.0;         ///< impacts at this time and later do not matter
};

inline constexpr double kNoImpact = kInfinity;

/// A time in [0, until) up to which the vertex, going from x0 to x1, stays at least min_distance away from the
/// convex polygon going from p0 to p1, or kNoImpact if it does all the way. 0 where it starts too close.
double vertex_polygon_toi(
    const Vec3& x0, const Vec3& x1, const Vec3* p0, const Vec3* p1, int count, const CcdOptions& options);

/// The same for two segments, each given by its two ends at the start and at the end of the motion.
double edge_edge_toi(const Vec3 a0[2], const Vec3 a1[2], const Vec3 b0[2], const Vec3 b1[2], const CcdOptions& options);

/// The same for a vertex at a signed distance above a plane.
double plane_toi(double distance0, double distance1, const CcdOptions& options);

}  // namespace diffsim
