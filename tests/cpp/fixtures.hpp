// Meshes, bodies and numeric derivatives that the core's tests share.
#pragma once

#include <Eigen/Geometry>
#include <vector>

#include "check.hpp"
#include "math/rotation.hpp"
#include "model/model.hpp"
#include "zone/zone_derivatives.hpp"

namespace fixtures {

using namespace diffsim;

// --- random values ---------------------------------------------------------------------------------------------------

Vec3 random_vec3(check::Random& random, double size = 1.0);
Vec3 random_direction(check::Random& random);
Mat3 random_rotation(check::Random& random);

/// Symmetric positive definite with eigenvalues from 1 to `ratio`.
Mat3 random_inertia(check::Random& random, double ratio);

// --- numeric derivatives ---------------------------------------------------------------------------------------------

/// Jacobian by fourth-order central differences: truncation O(step⁴), rounding O(eps / step).
template <typename Function>
MatrixX numeric_jacobian(const Function& function, const VectorX& x, double step) {
    const auto at = [&](Eigen::Index i, double by) -> VectorX {
        VectorX moved = x;
        moved[i] += by;
        return function(moved);
    };
    MatrixX jacobian;
    for (Eigen::Index i = 0; i < x.size(); ++i) {
        const VectorX near = at(i, step) - at(i, -step), far = at(i, 2.0 * step) - at(i, -2.0 * step);
        if (i == 0) jacobian.resize(near.size(), x.size());
        jacobian.col(i) = (8.0 * near - far) / (12.0 * step);
    }
    return jacobian;
}

/// Gradient of a scalar function in the same way.
template <typename Function>
VectorX numeric_gradient(const Function& function, const VectorX& x, double step) {
    return numeric_jacobian([&](const VectorX& at) { return VectorX::Constant(1, function(at)); }, x, step).transpose();
}

// --- meshes ----------------------------------------------------------------------------------------------------------

struct TriangleMesh {
    std::vector<Vec3> vertices;
    std::vector<Eigen::Vector3i> triangles;
};

/// Prism over a polygon in the xy plane, given counterclockwise with its triangulation, from z = bottom to z = top.
TriangleMesh prism(
    const std::vector<Eigen::Vector2d>& outline, const std::vector<Eigen::Vector3i>& cap, double bottom, double top);

TriangleMesh box(const Vec3& half);
/// Two arms of width 1 and outer length 2: a prism whose caps are not convex.
TriangleMesh l_shape();
TriangleMesh tetrahedron(double size = 1.0);
CollisionMesh collision_mesh(const TriangleMesh& mesh);

/// A convex polygon inscribed in an ellipse, in the plane through `center` with these axes.
std::vector<Vec3> random_polygon(check::Random& random, int count);

// --- bodies ----------------------------------------------------------------------------------------------------------

Body body(const TriangleMesh& mesh, double margin, BodyKind kind = BodyKind::dynamic);
Mat3 box_inertia(const Vec3& half, double mass);
ZoneBody zone_body(int id, const Pose& start, double mass, const Mat3& inertia_body);

/// The whole matrix of a block system.
MatrixX dense(const BlockSystem& system);

VectorX flatten(const Coordinates& y);
/// The first `body_count` times six numbers are bodies', the others nodes'. Default: there are bodies only.
Coordinates unflatten(const VectorX& x, Eigen::Index body_count = -1);

}  // namespace fixtures
