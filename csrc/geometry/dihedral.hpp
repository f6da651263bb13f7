#pragma once

#include "math/types.hpp"

/// The angle between two triangles that share an edge, with its derivatives.
namespace diffsim {

/// The frame of a hinge p0, p1, a, b: triangles (p0, p1, a) and (p1, p0, b). The normals are made from the edge and not
/// from any numbering of the triangles, so that neighbours may be given in opposite senses.
struct DihedralFrame {
    struct Side {
        Vec3 normal;        ///< unit
        Vec3 inward;        ///< unit, in the triangle's plane, from the edge at a right angle towards the corner
        double inv_height;  ///< of the corner above the edge [1/m]
        double foot;        ///< the corner's foot on the edge's line is p0 + foot (p1 - p0) [1]
    };

    bool degenerate = true;  ///< a triangle without area: the angle counts as 0, all its derivatives as 0
    double angle = 0.0;      ///< (-π, π], 0 where flat, positive where the corners lie behind the normals [rad]
    Vec3 along;              ///< unit, from p0 to p1; this and what follows is unset where degenerate
    double inv_length;       ///< of the edge [1/m]
    Side side[2];            ///< of a and of b
};

/// Columns of the points are p0, p1, a, b.
DihedralFrame dihedral_frame(const Mat34& points);

/// The angle's gradient, one column per point [rad/m].
Mat34 dihedral_gradient(const DihedralFrame& frame);

/// The angle's second derivative, in the order p0, p1, a, b [rad/m²].
Mat12 dihedral_hessian(const DihedralFrame& frame);

/// The same times the displacement of each point, one column each.
Mat34 dihedral_hessian_product(const DihedralFrame& frame, const Mat34& displacement);

/// An angle or a difference of two in (-π, π], moved there by at most one turn.
double wrap_angle(double angle);

}  // namespace diffsim
