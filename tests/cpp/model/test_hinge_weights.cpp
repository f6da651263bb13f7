#include "model/hinge_weights.hpp"

#include <Eigen/Eigenvalues>
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <functional>

#include "cloth_fixtures.hpp"
#include "geometry/dihedral.hpp"

namespace test_hinge_weights {

using namespace diffsim;
using fixtures::kPi;
using fixtures::TriangleMesh;

namespace {

constexpr double kRounding = 1e-12;
constexpr double kSmallAngles = 1e-8;  // of size 1e-6, which are not quite linear, and of their rounding
constexpr double kLeftOut = 1e-4;      // ten couplings of 1e-5 of the weights

Cloth build(const TriangleMesh& mesh) { return build_cloth(mesh.vertices, mesh.triangles, Vec3::UnitX()); }

MatrixX weight_matrix(const Cloth& cloth) {
    const Eigen::Index count = static_cast<Eigen::Index>(cloth.hinges.size());
    MatrixX weights = MatrixX::Zero(count, count);
    for (Eigen::Index h = 0; h < count; ++h) weights(h, h) = cloth.hinges[h].weight;
    for (const HingeCoupling& c : cloth.couplings) {
        CHECK(c.a < c.b);
        CHECK(weights(c.a, c.b) == 0.0);
        weights(c.a, c.b) = weights(c.b, c.a) = c.weight;
    }
    return weights;
}

/// Angles of a flat sheet bent a little, into z = w, by what is left of z where it is multiplied by a small number.
VectorX small_angles(const Cloth& cloth, const std::function<double(const Vec3&)>& w) {
    constexpr double kSmall = 1e-6;
    VectorX angles(static_cast<Eigen::Index>(cloth.hinges.size()));
    for (Eigen::Index h = 0; h < angles.size(); ++h) {
        Mat34 points;
        for (int k = 0; k < 4; ++k) {
            points.col(k) = cloth.rest[cloth.hinges[h].nodes[k]];
            points(2, k) = kSmall * w(points.col(k));
        }
        angles[h] = dihedral_frame(points).angle / kSmall;
    }
    return angles;
}

/// The sign of a hinge's angle where a sheet is curved upwards: its corners lie before normals that point up.
double sign_upwards(const Cloth& cloth, Eigen::Index hinge) {
    const std::array<int, 4>& nodes = cloth.hinges[hinge].nodes;
    const Vec3 edge = cloth.rest[nodes[1]] - cloth.rest[nodes[0]];
    return edge.cross(cloth.rest[nodes[2]] - cloth.rest[nodes[0]]).z() > 0.0 ? -1.0 : 1.0;
}

/// Grids of unit squares: cut alike, with alternating diagonals, and irregular.
std::vector<TriangleMesh> meshes(int count) {
    check::Random random(1);
    const TriangleMesh alike = fixtures::grid(count, count, 1.0);
    TriangleMesh alternating = alike, irregular = alike;
    for (int j = 0; j < count; ++j) {
        for (int i = j % 2; i < count; i += 2) {
            const int corner = i + j * (count + 1), square = 2 * (i + j * count);
            alternating.triangles[square] = {corner, corner + 1, corner + count + 1};
            alternating.triangles[square + 1] = {corner + 1, corner + count + 2, corner + count + 1};
        }
    }
    irregular.triangles = alternating.triangles;
    for (Vec3& node : irregular.vertices) node.head<2>() += fixtures::random_vec3(random, 0.2).head<2>();
    return {alike, alternating, irregular};
}

}  // namespace

TEST(constant_curvature_has_its_moments_on_any_mesh) {
    const int count = 10;
    for (const TriangleMesh& mesh : meshes(count)) {
        const Cloth cloth = build(mesh);
        const MatrixX weights = weight_matrix(cloth);
        for (const Vec3& k : {Vec3(1, 0, 0), Vec3(0, 1, 0), Vec3(0, 0, 1), Vec3(0.3, -0.8, 0.5)}) {
            NOTE(k);
            Mat3 curvature = Mat3::Zero();
            curvature(0, 0) = k[0];
            curvature(1, 1) = k[1];
            curvature(0, 1) = curvature(1, 0) = k[2];
            const VectorX angles =
                small_angles(cloth, [&](const Vec3& x) { return 0.5 * x.dot(curvature * x) + 0.3 * x.x() - x.y(); });
            const VectorX moments = weights * angles;
            int inside = 0;
            for (Eigen::Index h = 0; h < moments.size(); ++h) {
                const Vec3 &p0 = cloth.rest[cloth.hinges[h].nodes[0]], &p1 = cloth.rest[cloth.hinges[h].nodes[1]];
                const double rim = std::min({p0.x(), p0.y(), count - p0.x(), count - p0.y()});
                if (rim < 3.5) continue;  // the rim is free, and its triangles hold no moment across it
                const double length = (p1 - p0).norm();
                const Vec3 normal = (p1 - p0).cross(Vec3::UnitZ()) / length;
                CHECK_NEAR(moments[h], sign_upwards(cloth, h) * length * normal.dot(curvature * normal), kLeftOut);
                ++inside;
            }
            CHECK(inside >= 20);
        }
    }
}

TEST(a_strip_with_free_sides_bends_as_a_beam) {
    // Curved along x, a sheet has the energy ½ κ² per area of what belongs to a hinge across x, whatever its sides do,
    // and no way to do with less.
    const int count = 8;
    const std::vector<TriangleMesh> all = meshes(count);
    for (int k = 0; k < 2; ++k) {
        NOTE(k);
        const Cloth cloth = build(all[k]);
        const VectorX angles = small_angles(cloth, [](const Vec3& x) { return 0.5 * x.x() * x.x(); });
        const VectorX moments = weight_matrix(cloth) * angles;
        CHECK_NEAR(angles.dot(moments), count * (count - 1.0), kSmallAngles * count * count);
        for (Eigen::Index h = 0; h < moments.size(); ++h) {
            const std::array<int, 4>& nodes = cloth.hinges[h].nodes;
            double middle = 0.0;
            for (const int node : nodes) middle += 0.25 * cloth.rest[node].x();
            if (middle < 1.0 || middle > count - 1.0) continue;  // the ends would need a moment to stay curved
            const Vec3 edge = cloth.rest[nodes[1]] - cloth.rest[nodes[0]];
            CHECK_NEAR(moments[h], sign_upwards(cloth, h) * edge.y() * edge.y() / edge.norm(), kSmallAngles);
        }
    }
}

TEST(weights_are_positive_definite) {
    for (const TriangleMesh& mesh : meshes(6)) {
        const MatrixX weights = weight_matrix(build(mesh));
        const VectorX eigenvalues = Eigen::SelfAdjointEigenSolver<MatrixX>(weights).eigenvalues();
        CHECK(eigenvalues[0] > 1e-3);
        CHECK(eigenvalues.tail(1)[0] < 30.0);
    }
}

TEST(regular_grids_couple_no_more_than_they_must) {
    const std::vector<TriangleMesh> all = meshes(8);
    const Cloth cloth = build(all[0]);
    // A triangle's sides at a right angle know nothing of each other, and the diagonal couples to both.
    std::vector<int> partners(cloth.hinges.size(), 0);
    for (const HingeCoupling& c : cloth.couplings) {
        ++partners[c.a];
        ++partners[c.b];
    }
    for (std::size_t h = 0; h < cloth.hinges.size(); ++h) {
        const std::array<int, 4>& nodes = cloth.hinges[h].nodes;
        Vec3 lower = cloth.rest[nodes[0]], upper = lower;
        for (const int node : nodes) {
            lower = lower.cwiseMin(cloth.rest[node]);
            upper = upper.cwiseMax(cloth.rest[node]);
        }
        if (lower.head<2>().minCoeff() < 1.5 || upper.head<2>().maxCoeff() > 6.5) continue;
        const bool diagonal = (cloth.rest[nodes[1]] - cloth.rest[nodes[0]]).head<2>().norm() > 1.2;
        CHECK_NEAR(cloth.hinges[h].weight, diagonal ? 2.0 : 1.0, kRounding);
        CHECK(partners[h] == (diagonal ? 4 : 2));
    }
    for (const HingeCoupling& c : cloth.couplings) CHECK(std::abs(c.weight) > 0.1);
    TriangleMesh rounded = all[1];
    for (Vec3& node : rounded.vertices) node = (0.1 * node).cast<float>().cast<double>();
    CHECK(build(rounded).couplings.size() == build(all[1]).couplings.size());
}

TEST(folds_at_rest_do_not_matter) {
    const TriangleMesh flat = fixtures::grid(4, 4, 1.0);
    TriangleMesh folded = flat;  // along a straight line of edges
    for (Vec3& node : folded.vertices)
        if (node.x() > 2.0) node = {2.0, node.y(), node.x() - 2.0};
    CHECK_NEAR(weight_matrix(build(folded)), weight_matrix(build(flat)), kRounding);
}

TEST(the_sense_of_triangles_does_not_matter) {
    check::Random random(3);
    TriangleMesh mesh = meshes(4)[2];
    const MatrixX weights = weight_matrix(build(mesh));
    for (int k = 0; k < 10; ++k) {
        for (Eigen::Vector3i& t : mesh.triangles)
            if (random.uniform() < 0.0) std::swap(t[0], t[1]);
        CHECK_NEAR(weight_matrix(build(mesh)), weights, kRounding);
    }
}

TEST(size_does_not_matter) {
    TriangleMesh mesh = meshes(4)[2];
    const Cloth cloth = build(mesh);
    for (Vec3& node : mesh.vertices) node *= 1e-3;
    CHECK_NEAR(weight_matrix(build(mesh)), weight_matrix(cloth), kRounding);
}

}  // namespace test_hinge_weights
