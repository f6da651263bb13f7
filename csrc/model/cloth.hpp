#pragma once

#include <array>
#include <string>
#include <vector>

#include "geometry/collision_mesh.hpp"
#include "model/hinge_weights.hpp"

/// What a sheet of cloth is made of. Constant over time.
namespace diffsim {

struct ClothTriangle {
    std::array<int, 3> nodes;      ///< indices into the cloth's nodes
    Eigen::Matrix2d rest_inverse;  ///< inverse of [x1 - x0, x2 - x0] in material coordinates (warp, weft) [1/m]
    double area;                   ///< at rest [m²]
};

/// Two triangles that share an edge, and the spring between them.
struct ClothHinge {
    std::array<int, 4> nodes;  ///< ends p0 < p1 of the shared edge, then the opposite corners of its two triangles
    double rest_angle;         ///< dihedral angle at rest, 0 where flat (geometry/dihedral.hpp) [rad]
    double weight;  ///< stiffness in units of the cloth's, if no other hinge is bent (model/hinge_weights.hpp) [1]
};

struct Cloth {
    std::string name;
    double margin = 0.0;                   ///< the collision surface is the sheet offset by this [m]
    double poisson = 0.0;                  ///< Poisson's ratio, in (-1, 1) [1]
    int first_node = 0;                    ///< in the scene's node axis
    std::vector<Vec3> rest;                ///< nodes at rest [m]
    std::vector<char> pinned;              ///< one per node: moves as told
    std::vector<double> node_area;         ///< a third of the area of the triangles around each node, at rest [m²]
    std::vector<ClothTriangle> triangles;  ///< as given
    std::vector<ClothHinge> hinges;        ///< in the order of their edges
    std::vector<HingeCoupling> couplings;  ///< between hinges next to each other
    std::vector<std::pair<int, int>> node_pairs;  ///< i < j, sorted: nodes that some triangle or hinges couple
    CollisionMesh surface;                        ///< topology for collision: triangles unmerged, every edge

    int node_count() const { return static_cast<int>(rest.size()); }
};

/// Physical parameters of one cloth.
struct ClothParameters {
    double density = 0.0;  ///< [kg/m²]
    double stretch = 0.0;  ///< uniaxial stress resultant per strain, along warp and weft [N/m]
    double shear = 0.0;    ///< shear stress resultant per angle between warp and weft [N/m]
    double bend = 0.0;     ///< bending moment per curvature and width [N·m]
    double damping = 0.0;  ///< relaxation time of stretch, shear and bend, after Kelvin and Voigt [s]
};

/// A cloth with everything that follows from its rest shape; name, margin, poisson, first_node and the pins are left to
/// the caller. `warp` is the warp's direction (any length): in each triangle its projection onto the triangle's plane;
/// where it is nearly normal to that plane, the coordinate axis least aligned with it takes its place.
///
/// Neighbouring triangles may be given in opposite senses. Throws std::invalid_argument, naming the triangle, edge or
/// node, for indices out of range, triangles without area, edges of more than two triangles, two triangles with
/// the same corners, and nodes without a triangle (they would have no mass); and for no triangles at all or a warp of
/// length 0.
Cloth build_cloth(std::vector<Vec3> rest, const std::vector<Eigen::Vector3i>& triangles, const Vec3& warp);

}  // namespace diffsim
