#include "cloth_fixtures.hpp"

#include <cmath>

namespace fixtures {

TriangleMesh grid(int nx, int ny, double spacing) {
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

TriangleMesh hexagon(double side) {
    TriangleMesh mesh;
    mesh.vertices.emplace_back(0.0, 0.0, 0.0);
    for (int k = 0; k < 6; ++k) {
        mesh.vertices.emplace_back(side * std::cos(kPi * k / 3.0), side * std::sin(kPi * k / 3.0), 0.0);
        mesh.triangles.emplace_back(0, 1 + k, 1 + (k + 1) % 6);
    }
    return mesh;
}

TriangleMesh folded_pair(double angle) {
    return {{{0, 0, 0}, {1, 0, 0}, {0.5, 1, 0}, {0.5, -std::cos(angle), -std::sin(angle)}}, {{0, 1, 2}, {1, 0, 3}}};
}

Cloth cloth(const TriangleMesh& mesh, double margin) {
    Cloth result = build_cloth(mesh.vertices, mesh.triangles, Vec3(1.0, 0.2, 0.0));
    result.margin = margin;
    result.poisson = 0.2;
    return result;
}

std::vector<Vec3> rolled(const std::vector<Vec3>& sheet, double radius, double pitch) {
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

std::vector<Vec3> moved(std::vector<Vec3> x, const Mat3& R, const Vec3& shift) {
    for (Vec3& node : x) node = R * node + shift;
    return x;
}

std::vector<Vec3> shaken(std::vector<Vec3> x, check::Random& random, double size) {
    for (Vec3& node : x) node += random_vec3(random, size);
    return x;
}

void add_zone_cloth(
    Zone& zone, int id, const std::vector<Vec3>& start, const ClothParameters& parameters, double dt,
    const Vec3& target) {
    const Cloth& cloth = zone.model->cloths[static_cast<std::size_t>(id)];
    zone.cloths.push_back({id, zone.node_count(), {}});
    Straining& straining = zone.cloths.back().straining;
    straining.scale = dt * dt;
    straining.time = dt;
    straining.start = elastic_start(cloth, start.data());
    for (std::size_t k = 0; k < start.size(); ++k) {
        ZoneNode node;
        node.start = start[k];
        node.mass = parameters.density * cloth.node_area[k];
        node.pinned = cloth.pinned[k] != 0;
        node.target = target;
        zone.nodes.push_back(node);
    }
}

PassiveBodies passive_bodies(const Model& model, std::vector<PassiveBody> bodies) {
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

VectorX flatten_nodes(const std::vector<Vec3>& x) {
    VectorX flat(3 * static_cast<Eigen::Index>(x.size()));
    for (std::size_t i = 0; i < x.size(); ++i) flat.segment<3>(3 * static_cast<Eigen::Index>(i)) = x[i];
    return flat;
}

std::vector<Vec3> unflatten_nodes(const VectorX& flat) {
    std::vector<Vec3> x(static_cast<std::size_t>(flat.size() / 3));
    for (std::size_t i = 0; i < x.size(); ++i) x[i] = flat.segment<3>(3 * static_cast<Eigen::Index>(i));
    return x;
}

}  // namespace fixtures
