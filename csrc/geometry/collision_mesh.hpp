#pragma once

#include <map>
#include <utility>
#include <vector>

#include "geometry/box_tree.hpp"

namespace diffsim {

/// A convex planar polygon: one face of the mesh, or several coplanar ones merged. A body that is a point
/// or a segment has one patch of one or two vertices.
struct Patch {
    std::vector<int> vertices;  ///< counterclockwise seen from outside
    Vec3 normal;                ///< outward unit normal, body frame; zero without area
};

struct Edge {
    int p0, p1;
    Vec3 outward;  ///< sum of the unit normals of its faces, body frame; zero where a face has no other side
};

/// What of a surface takes part in collision, in groups that the tree's leaves hold. Every vertex and
/// every edge that is not flat belongs to exactly one cell, so that going over pairs of cells visits
/// each vertex-patch and edge-edge pair exactly once.
struct Cell {
    int patch = -1;
    std::vector<int> vertices;
    std::vector<int> edges;
};

/// What becomes a feature of a surface. `merged`: coplanar faces become convex patches and edges between coplanar
/// faces are dropped, because the contact energy counts one term per (vertex, patch) and per (edge, edge) pair: a
/// cube's face diagonal is no feature of a cube. `separate`: patch i is triangle i and every edge counts, for surfaces
/// that deform, whose flat spots do not stay flat.
enum class Faces { merged, separate };

/// The triangles around each edge of a mesh, ascending, keyed by the edge's sorted vertex pair.
using EdgeFaces = std::map<std::pair<int, int>, std::vector<int>>;
EdgeFaces collect_edge_faces(const std::vector<Eigen::Vector3i>& triangles);

/// Collision view of a triangle mesh, in the body frame. Constant over time; of a mesh that deforms only the topology
/// is, while positions, normals and boxes are those of the vertices it was built from.
struct CollisionMesh {
    std::vector<Vec3> vertices;
    std::vector<Patch> patches;
    std::vector<Edge> edges;
    std::vector<Cell> cells;
    bool closed = false;               ///< every edge has two faces, so that there is an inside
    BoxTree tree;                      ///< over the cells
    std::vector<int> active_vertices;  ///< those in some cell, ascending
    double radius = 0.0;               ///< largest distance of a vertex from the origin [m]
};

/// Build from vertices and triangles (indices into vertices). Without triangles: one vertex is a point,
/// two are a segment. Throws std::invalid_argument on anything else.
CollisionMesh build_collision_mesh(
    std::vector<Vec3> vertices, const std::vector<Eigen::Vector3i>& triangles, Faces faces = Faces::merged);

}  // namespace diffsim
