#include "contact/sides.hpp"

#include <Eigen/Geometry>

namespace diffsim {
namespace {

/// Rates of a triangle's barycentric coordinates along a direction in its plane.
Vec3 barycentric_rates(const Vec3& e1, const Vec3& e2, const Vec3& direction) {
    const double g11 = e1.squaredNorm(), g12 = e1.dot(e2), g22 = e2.squaredNorm();
    const double r1 = e1.dot(direction), r2 = e2.dot(direction);
    const double determinant = e1.cross(e2).squaredNorm();
    const double b1 = (g22 * r1 - g12 * r2) / determinant, b2 = (g11 * r2 - g12 * r1) / determinant;
    return {-b1 - b2, b1, b2};
}

}  // namespace

std::array<Vec3, 2> slide_directions(const ClosestPoint& closest, const Vec3& normal) {
    const int count = closest.slide_count;
    if (count == 0) return {Vec3::Zero(), Vec3::Zero()};
    if (count == 1) return {closest.edge.normalized(), Vec3::Zero()};
    const Vec3 first = closest.border_count == 1 ? Vec3(closest.edge.normalized()) : normal.unitOrthogonal();
    return {first, normal.cross(first)};
}

ClothSide cloth_side(const ClosestPoint& closest, const Vec3& normal, const Feature& feature, const Surface& cloth) {
    ClothSide side;
    const Vec3& point = closest.point;
    const std::array<int, 3> v = feature_vertices(*cloth.mesh, feature);
    if (v[1] < 0) {
        side.weights[0] = 1.0;
        return side;
    }
    // A segment: the edge, or the side of the triangle that is nearest. The code says which (see geometry/distance).
    int i = 0, j = 1, code;
    if (v[2] < 0) {
        code = static_cast<int>(closest.code);
        side.edge_length = (cloth.vertex(v[1]) - cloth.vertex(v[0])).norm();
    } else if (closest.code != 0) {
        i = static_cast<int>(closest.code - 1) / 3;
        j = (i + 1) % 3;
        code = static_cast<int>(closest.code - 1) % 3;
    } else {
        const Vec3 x0 = cloth.vertex(v[0]), e1 = cloth.vertex(v[1]) - x0, e2 = cloth.vertex(v[2]) - x0;
        side.weights = Vec3::UnitX() + barycentric_rates(e1, e2, point - x0);
        const std::array<Vec3, 2> slides = slide_directions(closest, normal);
        for (int k = 0; k < 2; ++k) side.slide[k] = barycentric_rates(e1, e2, slides[k]);
        return side;
    }
    if (code != 2) {
        side.weights[code == 0 ? i : j] = 1.0;
        return side;
    }
    const Vec3 x0 = cloth.vertex(v[i]), edge = cloth.vertex(v[j]) - x0;
    const double length = edge.norm();
    side.weights[j] = (point - x0).dot(edge) / (length * length);
    side.weights[i] = 1.0 - side.weights[j];
    side.slide[0][i] = -1.0 / length;
    side.slide[0][j] = 1.0 / length;
    return side;
}

Rows3<9> ClothMotion::direction(const Vec3& unit) const {
    const Mat3 projector = (Mat3::Identity() - unit * unit.transpose()) / m_side.edge_length;
    Rows3<9> result;
    result << -projector, projector, Mat3::Zero();
    return result;
}

Square<9> ClothMotion::direction_curvature(const Vec3& unit, const Vec3& other) const {
    // d²(other · e / |e|) with e the edge
    const double cosine = unit.dot(other);
    const Mat3 block = (3.0 * cosine * unit * unit.transpose() - other * unit.transpose() - unit * other.transpose() -
                        cosine * Mat3::Identity()) /
                       (m_side.edge_length * m_side.edge_length);
    Square<9> result = Square<9>::Zero();
    result.topLeftCorner<3, 3>() = block;
    result.block<3, 3>(3, 3) = block;
    result.block<3, 3>(0, 3) = -block;
    result.block<3, 3>(3, 0) = -block;
    return result;
}

}  // namespace diffsim
