// Sheets of cloth that the core's tests share.
#pragma once

#include <vector>

#include "fixtures.hpp"
#include "model/cloth.hpp"
#include "zone/zone_contacts.hpp"

namespace fixtures {

inline constexpr double kPi = EIGEN_PI;  // which is a long double

/// A rectangle in the xy plane from the origin, of nx x ny squares of side `spacing`, each cut along the diagonal from
/// its corner next to the origin. Node (i, j) is i + j (nx + 1).
TriangleMesh grid(int nx, int ny, double spacing);

/// Six equilateral triangles in the xy plane around node 0.
TriangleMesh hexagon(double side);

/// Two triangles of unit height at the edge from the origin to the unit of x, the second turned by `angle` off flat.
TriangleMesh folded_pair(double angle);

/// Weight of its hinge: twice the area ½ times what is left of curvature 1 across the edge, (0, 1, 0), where the other
/// edges' normals (±2, 1) / √5 are free to bend, whose tensors span (0.8, 0.2, 0) and (0, 0, 1).
inline constexpr double kFoldedPairWeight = 1.0 - 0.2 * 0.2 / (0.8 * 0.8 + 0.2 * 0.2);

/// A cloth of this rest shape; `first_node` is left to who builds the model.
Cloth cloth(const TriangleMesh& mesh, double margin = 0.0);

/// A rectangle of grid() rolled up around the y axis: turn after turn `pitch` further out from `radius`.
std::vector<Vec3> rolled(const std::vector<Vec3>& sheet, double radius, double pitch);
std::vector<Vec3> moved(std::vector<Vec3> x, const Mat3& R, const Vec3& shift);
std::vector<Vec3> shaken(std::vector<Vec3> x, check::Random& random, double size);

/// Append a cloth of zone.model, its nodes going from `start` to start + target in a step of dt.
void add_zone_cloth(
    Zone& zone, int id, const std::vector<Vec3>& start, const ClothParameters& parameters, double dt,
    const Vec3& target = Vec3::Zero());

/// Bodies that do not yield, over boxes around the segments of their motions.
PassiveBodies passive_bodies(const Model& model, std::vector<PassiveBody> bodies);

/// Call visit(contact) for all pairs of features of two meshes, or of one: those without a common vertex, each once.
template <class Visit>
void for_each_pair_of_features(
    int object_a, const CollisionMesh& a, int object_b, const CollisionMesh& b, const Visit& visit) {
    const bool same = object_a == object_b;
    const auto pair = [&](ContactType type, int feature_a, int feature_b) {
        const Contact contact{object_a, object_b, type, feature_a, feature_b};
        if (same)
            for (int i : feature_vertices(a, contact.on_a()))
                for (int j : feature_vertices(b, contact.on_b()))
                    if (i >= 0 && i == j) return;
        visit(contact);
    };
    const auto count = [](const auto& list) { return static_cast<int>(list.size()); };
    for (int v : a.active_vertices)
        for (int p = 0; p < count(b.patches); ++p) pair(ContactType::vertex_patch, v, p);
    for (int p = 0; p < count(a.patches) && !same; ++p)
        for (int v : b.active_vertices) pair(ContactType::patch_vertex, p, v);
    for (int i = 0; i < count(a.edges); ++i)
        for (int j = same ? i + 1 : 0; j < count(b.edges); ++j) pair(ContactType::edge_edge, i, j);
}

VectorX flatten_nodes(const std::vector<Vec3>& x);
std::vector<Vec3> unflatten_nodes(const VectorX& flat);

}  // namespace fixtures
