#include "fixtures.hpp"

#include <cmath>
#include <utility>

namespace fixtures {

Vec3 random_vec3(check::Random& random, double size) { return random.vector(3, -size, size); }

Vec3 random_direction(check::Random& random) {
    Vec3 v;
    do v = random_vec3(random);
    while (v.norm() < 0.1 || v.norm() > 1.0);
    return v.normalized();
}

Mat3 random_rotation(check::Random& random) {
    return exp_rotation(random.uniform(0.0, 3.0) * random_direction(random));
}

Mat3 random_inertia(check::Random& random, double ratio) {
    const Mat3 R = random_rotation(random);
    return R * Vec3(1.0, random.uniform(1.0, ratio), ratio).asDiagonal() * R.transpose();
}

TriangleMesh prism(
    const std::vector<Eigen::Vector2d>& outline, const std::vector<Eigen::Vector3i>& cap, double bottom, double top) {
    TriangleMesh mesh;
    const int count = static_cast<int>(outline.size());
    for (const double z : {bottom, top})
        for (const Eigen::Vector2d& p : outline) mesh.vertices.emplace_back(p.x(), p.y(), z);
    for (const Eigen::Vector3i& t : cap) {
        mesh.triangles.emplace_back(t[0], t[2], t[1]);
        mesh.triangles.emplace_back(count + t[0], count + t[1], count + t[2]);
    }
    for (int i = 0; i < count; ++i) {
        const int j = (i + 1) % count;
        mesh.triangles.emplace_back(i, j, count + j);
        mesh.triangles.emplace_back(i, count + j, count + i);
    }
    return mesh;
}

TriangleMesh box(const Vec3& half) {
    return prism(
        {{-half.x(), -half.y()}, {half.x(), -half.y()}, {half.x(), half.y()}, {-half.x(), half.y()}},
        {{0, 1, 2}, {0, 2, 3}}, -half.z(), half.z());
}

TriangleMesh l_shape() {
    return prism({{0, 0}, {2, 0}, {2, 1}, {1, 1}, {1, 2}, {0, 2}}, {{0, 1, 2}, {0, 2, 3}, {0, 3, 4}, {0, 4, 5}}, 0, 1);
}

TriangleMesh tetrahedron(double size) {
    TriangleMesh mesh;
    mesh.vertices = {{1, 1, 1}, {1, -1, -1}, {-1, 1, -1}, {-1, -1, 1}};
    for (Vec3& x : mesh.vertices) x *= size;
    mesh.triangles = {{0, 1, 2}, {0, 3, 1}, {0, 2, 3}, {1, 3, 2}};
    return mesh;
}

CollisionMesh collision_mesh(const TriangleMesh& mesh) { return build_collision_mesh(mesh.vertices, mesh.triangles); }

std::vector<Vec3> random_polygon(check::Random& random, int count) {
    const Mat3 R = random_rotation(random);
    const Vec3 center = random_vec3(random);
    const double width = random.uniform(0.3, 1.5), height = random.uniform(0.3, 1.5);
    std::vector<Vec3> corners;
    for (int k = 0; k < count; ++k) {
        const double angle = 2.0 * EIGEN_PI * (k + random.uniform(0.0, 0.7)) / count;
        corners.push_back(center + R * Vec3(width * std::cos(angle), height * std::sin(angle), 0.0));
    }
    return corners;
}

Body body(const TriangleMesh& mesh, double margin, BodyKind kind) {
    Body result;
    result.kind = kind;
    result.margin = margin;
    result.mesh = collision_mesh(mesh);
    return result;
}

Mat3 box_inertia(const Vec3& half, double mass) {
    const Vec3 sq = half.cwiseAbs2();
    return mass / 3.0 * Vec3(sq.y() + sq.z(), sq.x() + sq.z(), sq.x() + sq.y()).asDiagonal().toDenseMatrix();
}

ZoneBody zone_body(int id, const Pose& start, double mass, const Mat3& inertia_body) {
    ZoneBody result;
    result.id = id;
    result.start = start;
    result.mass = mass;
    result.inertia = start.R * inertia_body * start.R.transpose();
    result.inverse_inertia = result.inertia.inverse();
    return result;
}

MatrixX dense(const BlockSystem& system) {
    const BlockPattern& pattern = system.pattern();
    const int bodies = pattern.body_count, first_node = 6 * bodies, size = first_node + 3 * pattern.node_count;
    MatrixX matrix = MatrixX::Zero(size, size);
    for (int i = 0; i < bodies; ++i) matrix.block<6, 6>(6 * i, 6 * i) = system.diagonal(i);
    for (int i = 0; i < pattern.node_count; ++i)
        matrix.block<3, 3>(first_node + 3 * i, first_node + 3 * i) = system.node_diagonal(i);
    const auto add = [&](int row, int column, const MatrixX& block) {
        matrix.block(row, column, block.rows(), block.cols()) = block;
        matrix.block(column, row, block.cols(), block.rows()) = block.transpose();
    };
    for (std::size_t k = 0; k < pattern.body_pairs.size(); ++k)
        add(6 * pattern.body_pairs[k].first, 6 * pattern.body_pairs[k].second,
            system.off_diagonal(static_cast<int>(k)));
    for (std::size_t k = 0; k < pattern.mixed_pairs.size(); ++k)
        add(6 * pattern.mixed_pairs[k].first, first_node + 3 * pattern.mixed_pairs[k].second,
            system.mixed_pair(static_cast<int>(k)));
    for (std::size_t k = 0; k < pattern.node_pairs.size(); ++k)
        add(first_node + 3 * pattern.node_pairs[k].first, first_node + 3 * pattern.node_pairs[k].second,
            system.node_pair(static_cast<int>(k)));
    return matrix;
}

VectorX flatten(const Coordinates& y) {
    const Eigen::Index bodies = static_cast<Eigen::Index>(y.bodies.size());
    VectorX x(6 * bodies + 3 * static_cast<Eigen::Index>(y.nodes.size()));
    for (std::size_t i = 0; i < y.bodies.size(); ++i) x.segment<6>(6 * static_cast<Eigen::Index>(i)) = y.bodies[i];
    for (std::size_t i = 0; i < y.nodes.size(); ++i)
        x.segment<3>(6 * bodies + 3 * static_cast<Eigen::Index>(i)) = y.nodes[i];
    return x;
}

Coordinates unflatten(const VectorX& x, Eigen::Index body_count) {
    if (body_count < 0) body_count = x.size() / 6;
    Coordinates y;
    y.resize(static_cast<std::size_t>(body_count), static_cast<std::size_t>((x.size() - 6 * body_count) / 3));
    for (std::size_t i = 0; i < y.bodies.size(); ++i) y.bodies[i] = x.segment<6>(6 * static_cast<Eigen::Index>(i));
    for (std::size_t i = 0; i < y.nodes.size(); ++i)
        y.nodes[i] = x.segment<3>(6 * body_count + 3 * static_cast<Eigen::Index>(i));
    return y;
}

}  // namespace fixtures
