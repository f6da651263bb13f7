#include "geometry/dihedral.hpp"

#include <cmath>

#include "cloth_fixtures.hpp"

namespace test_dihedral {

using namespace diffsim;
using fixtures::kPi;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

Mat34 columns(const std::vector<Vec3>& x) {
    Mat34 points;
    for (int k = 0; k < 4; ++k) points.col(k) = x[k];
    return points;
}

Mat34 folded(double angle) { return columns(fixtures::folded_pair(angle).vertices); }

VectorX as_vector(const Mat34& points) { return points.reshaped(); }

Mat34 as_points(const VectorX& x) { return x.reshaped(3, 4); }

/// From the unit normals and their cosine, on the side that one's corner has of the other's plane.
double obvious_angle(const Mat34& points) {
    const Vec3 p0 = points.col(0), p1 = points.col(1), a = points.col(2), b = points.col(3);
    const Vec3 normal_a = (p1 - p0).cross(a - p0).normalized(), normal_b = (b - p0).cross(p1 - p0).normalized();
    const double angle = std::acos(normal_a.dot(normal_b));
    return normal_a.dot(b - p0) > 0.0 ? -angle : angle;
}

Mat34 random_hinge(check::Random& random) {
    for (;;) {
        const Mat34 points = random.matrix(3, 4);
        const DihedralFrame frame = dihedral_frame(points);
        // Away from the jump at half a turn, and of a size at which differences can see the derivatives.
        if (std::abs(frame.angle) < 2.8 && frame.side[0].inv_height < 4.0 && frame.side[1].inv_height < 4.0 &&
            frame.inv_length < 4.0)
            return points;
    }
}

}  // namespace

TEST(angles_of_a_fold) {
    check::Random random(1);
    for (const double angle : {0.0, 1e-9, 1e-3, 0.5 * kPi, 3.0, -1e-9, -0.7, -3.1}) {
        NOTE(angle);
        CHECK_NEAR(dihedral_frame(folded(angle)).angle, angle, 1e-15);
        const Mat34 turned = (random_rotation(random) * folded(angle)).colwise() + random_vec3(random);
        CHECK_NEAR(dihedral_frame(turned).angle, angle, 1e-14);
    }
    CHECK_NEAR(std::abs(dihedral_frame(folded(kPi)).angle), kPi, 1e-15);
}

TEST(the_angle_is_that_between_normals) {
    check::Random random(2);
    for (int k = 0; k < 200; ++k) {
        const Mat34 points = random_hinge(random);
        CHECK_NEAR(dihedral_frame(points).angle, obvious_angle(points), 1e-7);  // the arc cosine's rounding next to 0
    }
}

TEST(the_frame_is_orthonormal_and_measures_the_triangles) {
    check::Random random(3);
    for (int k = 0; k < 50; ++k) {
        const Mat34 points = random_hinge(random);
        const DihedralFrame frame = dihedral_frame(points);
        CHECK_NEAR(frame.along / frame.inv_length, Vec3(points.col(1) - points.col(0)), 1e-14);
        for (int side = 0; side < 2; ++side) {
            Mat3 axes;
            axes << frame.along, frame.side[side].normal, frame.side[side].inward;
            CHECK_NEAR(axes.transpose() * axes, Mat3::Identity(), 1e-13);
            const double foot = frame.side[side].foot;
            const Vec3 below = (1.0 - foot) * points.col(0) + foot * points.col(1);
            const Vec3 corner = points.col(2 + side);
            CHECK_NEAR(below + frame.side[side].inward / frame.side[side].inv_height, corner, 1e-13);
        }
    }
}

TEST(dihedral_derivatives_agree_with_differences) {
    check::Random random(4);
    for (int k = 0; k < 50; ++k) {
        const Mat34 points = random_hinge(random);
        const DihedralFrame frame = dihedral_frame(points);
        const Mat34 gradient = dihedral_gradient(frame);
        const Mat12 hessian = dihedral_hessian(frame);
        const auto angle = [](const VectorX& x) { return dihedral_frame(as_points(x)).angle; };
        const auto slope = [](const VectorX& x) { return as_vector(dihedral_gradient(dihedral_frame(as_points(x)))); };
        const VectorX x = as_vector(points);
        CHECK(gradient.norm() > 0.1);
        CHECK(hessian.norm() > 0.1);
        CHECK_NEAR(as_vector(gradient), fixtures::numeric_gradient(angle, x, 1e-4), 1e-9 * gradient.norm());
        CHECK_NEAR(MatrixX(hessian), fixtures::numeric_jacobian(slope, x, 1e-4), 1e-9 * hessian.norm());
        CHECK_NEAR(hessian, Mat12(hessian.transpose()), 1e-14 * hessian.norm());

        const Mat34 direction = random.matrix(3, 4);
        const VectorX product = hessian * as_vector(direction);
        CHECK_NEAR(as_vector(dihedral_hessian_product(frame, direction)), product, 1e-13 * hessian.norm());
    }
}

TEST(slivers_have_finite_derivatives) {
    for (const double height : {1e-3, 1e-6, 1e-9, 1e-30, 1e-80}) {
        NOTE(height);
        Mat34 points = folded(0.4);
        points.col(2) = Vec3(0.3, 0.0, height);
        const DihedralFrame frame = dihedral_frame(points);
        CHECK(!frame.degenerate);
        CHECK_NEAR(frame.angle, 0.4 - 0.5 * kPi, 1e-14);
        const Vec3 slope = dihedral_gradient(frame).col(2);
        CHECK_NEAR(slope, Vec3(0.0, 1.0 / height, 0.0), 1e-14 / height);
        CHECK(dihedral_hessian(frame).allFinite());
        CHECK(dihedral_hessian_product(frame, Mat34::Ones()).allFinite());
    }
}

TEST(collapsed_triangles_have_no_angle) {
    std::vector<Mat34> collapsed(5, folded(0.4));
    collapsed[0].col(2) = Vec3(0.3, 0.0, 0.0);  // on the edge
    collapsed[1].col(3) = collapsed[1].col(0);  // on an end
    collapsed[2].col(1) = collapsed[2].col(0);  // no edge
    collapsed[3].setZero();                     // a point
    collapsed[4] *= 1e-60;                      // too small for the inverse of its size
    for (const Mat34& points : collapsed) {
        NOTE(points);
        const DihedralFrame frame = dihedral_frame(points);
        CHECK(frame.degenerate);
        CHECK(frame.angle == 0.0);
        CHECK(dihedral_gradient(frame).isZero(0.0));
        CHECK(dihedral_hessian(frame).isZero(0.0));
        CHECK(dihedral_hessian_product(frame, Mat34::Ones()).isZero(0.0));
    }
}

TEST(angles_wrap_to_half_a_turn) {
    for (const double angle : {-3.0, -0.1, 0.0, 2.0, kPi}) CHECK(wrap_angle(angle) == angle);
    CHECK_NEAR(wrap_angle(-kPi), kPi, 0.0);
    CHECK_NEAR(wrap_angle(6.0), 6.0 - 2.0 * kPi, 1e-15);
    CHECK_NEAR(wrap_angle(-6.0), 2.0 * kPi - 6.0, 1e-15);
}

}  // namespace test_dihedral
