// Sheets of cloth that the core's tests share.
#pragma once

#include <cmath>
#include <vector>

#include "fixtures.hpp"
#include "model/cloth.hpp"
#include "zone/zone_contacts.hpp"

namespace fixtures {

inline constexpr double kPi = EIGEN_PI;  // which is a long double

/// A rectangle in the xy plane from the origin, of nx x ny squares of side `spacing`, each cut along the diagonal from
/// its corner next to the origin. Node (i, j) is i + j (nx + 1).
inline TriangleMesh grid(int nx, int ny, double spacing) {
    TriangleMesh mesh;
    for (int j = 0; j <= ny; ++j)
        for (int i = 0; i <= nx; ++i) mesh.vertices.emplace_back(i * spacing, j * spacing, 0.0);
    for (int j = 0; j < ny; ++j)
        for (int i = 0; i < nx; ++i) {
            const int corner = i + j * (nx + 1);
            mesh.triangles.emplace_back(corner, corner + 1, corner + nx + 2);
            mesh.triangles.emplace_back(corner, corner + nx + 2, corner + nx + 1);
        }
    return mesh;
}

/// Six equilateral triangles in the xy plane around node 0.
inline TriangleMesh hexagon(double side) {
    TriangleMesh mesh;
    mesh.vertices.emplace_back(0.0, 0.0, 0.0);
    for (int k = 0; k < 6; ++k) {
        mesh.vertices.emplace_back(side * std::cos(kPi * k / 3.0), side * std::sin(kPi * k / 3.0), 0.0);
        mesh.triangles.emplace_back(0, 1 + k, 1 + (k + 1) % 6);
    }
    return mesh;
}

/// Two triangles of unit height at the edge from the origin to the unit of x, the second turned by `angle` off flat.
inline TriangleMesh folded_pair(double angle) {
    return {{{0, 0, 0}, {1, 0, 0}, {0.5, 1, 0}, {0.5, -std::cos(angle), -std::sin(angle)}}, {{0, 1, 2}, {1, 0, 3}}};
}

/// Weight of its hinge: twice the area ½ times what is left of curvature 1 across the edge, (0, 1, 0), where the other
/// edges' normals (±2, 1) / √5 are free to bend, whose tensors span (0.8, 0.2, 0) and (0, 0, 1).
inline constexpr double kFoldedPairWeight = 1.0 - 0.2 * 0.2 / (0.8 * 0.8 + 0.2 * 0.2);

/// A cloth of this rest shape; `first_node` is left to who builds the model.
inline Cloth cloth(const TriangleMesh& mesh, double margin = 0.0) {
    Cloth result = build_cloth(mesh.vertices, mesh.triangles, Vec3(1.0, 0.2, 0.0));
    result.margin = margin;
    result.poisson = 0.2;
    return result;
}

/// A rectangle of grid() rolled up around the y axis: turn after turn `pitch` further out from `radius`.
inline std::vector<Vec3> rolled(const std::vector<Vec3>& sheet, double radius, double pitch) {
    std::vector<Vec3> result;
    for (const Vec3& x : sheet) {
        // r = radius + c angle, and x is about radius angle + c/2 angle² along the spiral
        const double c = pitch / (2.0 * kPi);
        const double angle = (std::sqrt(radius * radius + 2.0 * c * x.x()) - radius) / c;
        const double r = radius + c * angle;
        result.emplace_back(r * std::cos(angle), x.y(), r * std::sin(angle));
    }
    return result;
}

inline std::vector<Vec3> moved(std::vector<Vec3> x, const Mat3& R, const Vec3& shift) {
    for (Vec3& node : x) node = R * node + shift;
    return x;
}

inline std::vector<Vec3> shaken(std::vector<Vec3> x, check::Random& random, double size) {
    for (Vec3& node : x) node += random_vec3(random, size);
    return x;
}

/// Append a cloth of zone.model, its nodes going from `start` to start + target.
inline void add_zone_cloth(
    Zone& zone, int id, const std::vector<Vec3>& start, const ClothParameters& parameters,
    const Vec3& target = Vec3::Zero()) {
    const Cloth& cloth = zone.model->cloths[static_cast<std::size_t>(id)];
    zone.cloths.push_back({id, zone.node_count(), elastic_start(cloth, start.data())});
    for (std::size_t k = 0; k < start.size(); ++k) {
        ZoneNode node;
        node.start = start[k];
        node.mass = parameters.density * cloth.node_area[k];
        node.pinned = cloth.pinned[k] != 0;
        node.target = target;
        zone.nodes.push_back(node);
    }
}

/// Bodies that do not yield, over boxes around the segments of their motions.
inline PassiveBodies passive_bodies(const Model& model, std::vector<PassiveBody> bodies) {
    PassiveBodies result;
    result.bodies = std::move(bodies);
    std::vector<Box> boxes;
    for (const PassiveBody& body : result.bodies) {
        ZoneBody driven;
        driven.start = body.start;
        const Body& shape = model.bodies[static_cast<std::size_t>(body.id)];
        boxes.push_back(
            swept_box({&shape.mesh, {body.start, pose_at(driven, body.target)}, shape.margin + shape.mesh.radius}));
    }
    result.tree = build_box_tree(boxes);
    return result;
}

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

inline VectorX flatten_nodes(const std::vector<Vec3>& x) {
    VectorX flat(3 * static_cast<Eigen::Index>(x.size()));
    for (std::size_t i = 0; i < x.size(); ++i) flat.segment<3>(3 * static_cast<Eigen::Index>(i)) = x[i];
    return flat;
}

inline std::vector<Vec3> unflatten_nodes(const VectorX& flat) {
    std::vector<Vec3> x(static_cast<std::size_t>(flat.size() / 3));
    for (std::size_t i = 0; i < x.size(); ++i) x[i] = flat.segment<3>(3 * static_cast<Eigen::Index>(i));
    return x;
}

}  // namespace fixtures
