#pragma once

#include <Eigen/Geometry>
#include <array>

#include "contact/contact.hpp"
#include "math/rotation.hpp"

/// The two sides of a contact, and how each moves its closest point and the directions of its feature.
///
/// A rigid body moves along its twist at its current pose, (turn, shift): a turn phi moves x -> Exp(phi) (x - t) + t
/// about the centre of mass t. Cloth moves with the three nodes of a feature; an edge and a vertex use the first two
/// and the first. The ground does not move.
namespace diffsim {

/// A contact on a rigid body.
struct BodySide {
    static constexpr int kSize = 6;
    Vec3 center;  ///< of mass, in the frame of the contact's points
};

/// A contact on a feature of a cloth.
struct ClothSide {
    static constexpr int kSize = 9;
    Vec3 weights = Vec3::Zero();                               ///< of the nodes in the closest point
    std::array<Vec3, 2> slide = {Vec3::Zero(), Vec3::Zero()};  ///< their rates when the point slides
    double edge_length = 0.0;                                  ///< of an edge
};

/// A contact on the ground.
struct GroundSide {
    static constexpr int kSize = 0;
};

/// What a cloth's feature contributes to a contact: where on it the closest point lies.
ClothSide cloth_side(const ClosestPoint& closest, const Vec3& normal, const Feature& feature, const Surface& cloth);

/// Orthonormal directions along which a closest point slides on its object, as many as its count says. On the border of
/// a face the first runs along it.
std::array<Vec3, 2> slide_directions(const ClosestPoint& closest, const Vec3& normal);

template <int N>
using Rows3 = Eigen::Matrix<double, 3, N>;

/// ½ (r nᵀ + n rᵀ) - (n·r) I: second derivative of n · Exp(phi) r at phi = 0.
inline Mat3 turn_curvature(const Vec3& r, const Vec3& n) {
    Mat3 m = 0.5 * (r * n.transpose() + n * r.transpose());
    m.diagonal().array() -= n.dot(r);
    return m;
}

/// How the turn of a rigid body moves the closest point on it and the directions of its features. Of two bodies only
/// their relative shift matters, so that of one of them the turn is enough.
class TurnMotion {
public:
    static constexpr int kSize = 3;
    static constexpr int kTurnSize = 3;  ///< the first coordinates, which alone change directions
    TurnMotion(const BodySide& side, const Vec3& point) : m_arm(point - side.center) {}

    /// n · d(point).
    Vec3 row(const Vec3& n) const { return m_arm.cross(n); }
    /// n · d²(point).
    Mat3 point_curvature(const Vec3& n) const { return turn_curvature(m_arm, n); }
    /// n · d(slide direction k).
    Vec3 slide(int, const Vec3& direction, const Vec3& n) const { return direction.cross(n); }
    /// d(unit direction of an edge).
    Mat3 direction(const Vec3& unit) const { return -skew(unit); }
    /// other · d²(unit direction of an edge).
    Mat3 direction_curvature(const Vec3& unit, const Vec3& other) const { return turn_curvature(unit, other); }

private:
    Vec3 m_arm;
};

/// The same for turn and shift of a rigid body.
class BodyMotion {
public:
    static constexpr int kSize = 6;
    static constexpr int kTurnSize = 3;
    BodyMotion(const BodySide& side, const Vec3& point) : m_turn(side, point) {}

    Vec6 row(const Vec3& n) const {
        Vec6 result;
        result << m_turn.row(n), n;
        return result;
    }
    Mat3 point_curvature(const Vec3& n) const { return m_turn.point_curvature(n); }
    Vec3 slide(int k, const Vec3& direction, const Vec3& n) const { return m_turn.slide(k, direction, n); }
    Mat3 direction(const Vec3& unit) const { return m_turn.direction(unit); }
    Mat3 direction_curvature(const Vec3& unit, const Vec3& other) const {
        return m_turn.direction_curvature(unit, other);
    }

private:
    TurnMotion m_turn;
};

/// The same for the nodes of a cloth's feature. Nodes move on straight lines: their point has no curvature of its own.
class ClothMotion {
public:
    static constexpr int kSize = 9;
    static constexpr int kTurnSize = 9;
    ClothMotion(const ClothSide& side, const Vec3&) : m_side(side) {}

    Vector<9> row(const Vec3& n) const { return weighted(m_side.weights, n); }
    Vector<9> slide(int k, const Vec3&, const Vec3& n) const { return weighted(m_side.slide[k], n); }
    Rows3<9> direction(const Vec3& unit) const;
    Square<9> direction_curvature(const Vec3& unit, const Vec3& other) const;

private:
    static Vector<9> weighted(const Vec3& weights, const Vec3& n) {
        Vector<9> result;
        result << weights[0] * n, weights[1] * n, weights[2] * n;
        return result;
    }

    const ClothSide& m_side;
};

inline BodyMotion motion_of(const BodySide& side, const Vec3& point) { return {side, point}; }
inline ClothMotion motion_of(const ClothSide& side, const Vec3& point) { return {side, point}; }

/// direction · d(point of a - point of b): a row of the paper's J, in the coordinates of both sides.
template <class A, class B>
Vector<A::kSize + B::kSize> relative_row(const A& a, const B& b, const Vec3& direction) {
    Vector<A::kSize + B::kSize> row;
    row << a.row(direction), -b.row(direction);
    return row;
}

}  // namespace diffsim
