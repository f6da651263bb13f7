// Sheets of cloth that the core's tests share.
#pragma once

#include <cmath>
#include <vector>

#include "fixtures.hpp"
#include "model/cloth.hpp"

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
