#include "contact/contact_derivatives.hpp"

#include <Eigen/Geometry>
#include <cmath>
#include <type_traits>
#include <utility>

#include "math/rotation.hpp"

namespace diffsim {
namespace {

template <int N>
using Rows3 = Eigen::Matrix<double, 3, N>;

/// ½ (r nᵀ + n rᵀ) - (n·r) I: second derivative of n · Exp(phi) r at phi = 0.
Mat3 turn_curvature(const Vec3& r, const Vec3& n) {
    Mat3 m = 0.5 * (r * n.transpose() + n * r.transpose());
    m.diagonal().array() -= n.dot(r);
    return m;
}

/// How the turn of a rigid body moves the closest point on it and the directions of its features. Of two bodies only their
/// relative shift matters, so that of one of them the turn is enough.
class TurnMotion {
public:
    static constexpr int kSize = 3;
    static constexpr int kSlideSize = 3;  ///< the first coordinates, which alone change the slide directions
    TurnMotion(const BodySide& side, const Vec3& point) : m_arm(point - side.center) {}

    /// n · d(point).
    Vec3 row(const Vec3& n) const { return m_arm.cross(n); }
    /// Add n · d²(point), times a factor.
    template <class Block>
    void add_point_curvature(const Vec3& n, double factor, Block&& hessian) const {
        hessian += factor * turn_curvature(m_arm, n);
    }
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
    static constexpr int kSlideSize = 3;
    BodyMotion(const BodySide& side, const Vec3& point) : m_turn(side, point) {}

    Vec6 row(const Vec3& n) const {
        Vec6 result;
        result << m_turn.row(n), n;
        return result;
    }
    template <class Block>
    void add_point_curvature(const Vec3& n, double factor, Block&& hessian) const {
        m_turn.add_point_curvature(n, factor, hessian.template topLeftCorner<3, 3>());
    }
    Vec3 slide(int k, const Vec3& direction, const Vec3& n) const { return m_turn.slide(k, direction, n); }
    Rows3<6> direction(const Vec3& unit) const {
        Rows3<6> result = Rows3<6>::Zero();
        result.leftCols<3>() = m_turn.direction(unit);
        return result;
    }
    Mat6 direction_curvature(const Vec3& unit, const Vec3& other) const {
        Mat6 result = Mat6::Zero();
        result.topLeftCorner<3, 3>() = m_turn.direction_curvature(unit, other);
        return result;
    }

private:
    TurnMotion m_turn;
};

/// The same for the nodes of a cloth's feature.
class ClothMotion {
public:
    static constexpr int kSize = 9;
    static constexpr int kSlideSize = 9;
    ClothMotion(const ClothSide& side, const Vec3&) : m_side(side) {}

    Vector<9> row(const Vec3& n) const { return weighted(m_side.weights, n); }
    template <class Block>
    void add_point_curvature(const Vec3&, double, Block&&) const {}
    Vector<9> slide(int k, const Vec3&, const Vec3& n) const { return weighted(m_side.slide[k], n); }
    Rows3<9> direction(const Vec3& unit) const {
        const Mat3 projector = (Mat3::Identity() - unit * unit.transpose()) / m_side.edge_length;
        Rows3<9> result;
        result << -projector, projector, Mat3::Zero();
        return result;
    }
    Square<9> direction_curvature(const Vec3& unit, const Vec3& other) const {
        // d²(other · e / |e|) with e the edge
        const double cosine = unit.dot(other);
        const Mat3 block = (3.0 * cosine * unit * unit.transpose() - other * unit.transpose() -
                            unit * other.transpose() - cosine * Mat3::Identity()) /
                           (m_side.edge_length * m_side.edge_length);
        Square<9> result = Square<9>::Zero();
        result.topLeftCorner<3, 3>() = block;
        result.block<3, 3>(3, 3) = block;
        result.block<3, 3>(0, 3) = -block;
        result.block<3, 3>(3, 0) = -block;
        return result;
    }

private:
    static Vector<9> weighted(const Vec3& weights, const Vec3& n) {
        Vector<9> result;
        result << weights[0] * n, weights[1] * n, weights[2] * n;
        return result;
    }

    const ClothSide& m_side;
};

BodyMotion motion_of(const BodySide& side, const Vec3& point) { return {side, point}; }
ClothMotion motion_of(const ClothSide& side, const Vec3& point) { return {side, point}; }

/// direction · d(point_a - point_b).
template <class A, class B>
Vector<A::kSize + B::kSize> relative_row(const A& a, const B& b, const Vec3& direction) {
    Vector<A::kSize + B::kSize> row;
    row << a.row(direction), -b.row(direction);
    return row;
}

/// Add factor * r rᵀ.
template <int N>
void add_square(const Vector<N>& r, double factor, Square<N>& hessian) {
    hessian.noalias() += (factor * r) * r.transpose();
}

/// Add r qᵀ + q rᵀ, q being zero but for the coordinates from `first` on.
template <int N, int M>
void add_symmetric(const Vector<N>& r, const Vector<M>& q, int first, Square<N>& hessian) {
    const Eigen::Matrix<double, N, M> product = r * q.transpose();
    hessian.template middleCols<M>(first) += product;
    hessian.template middleRows<M>(first) += product.transpose();
}

/// Add, times a factor, the second derivative of the distance d = min over the slides s of |w(y, s)|. With W = dw/dy,
/// S = dw/ds, G = (SᵀS)⁻¹, q = n · dS/dy, and N the projector on what is orthogonal to S and n:
///     WᵀNW/d - WᵀSGq - (WᵀSGq)ᵀ - d qᵀGq + n · d²w/dy²  =  WᵀNW/d - X - Xᵀ + n · d²w/dy²,  X = (SᵀW + ½ d q)ᵀ G q.
/// A slide of one object changes its direction with the coordinates of that object alone.
template <class A, class B>
void add_distance_hessian(
    const ContactGeometry& geometry, const A& a, const B& b, double factor, Square<A::kSize + B::kSize>& hessian) {
    constexpr int kSize = A::kSize + B::kSize;
    const Vec3& n = geometry.normal;
    const double d = geometry.distance;
    const ClosestPoints& points = geometry.closest;
    a.add_point_curvature(n, factor, hessian.template topLeftCorner<A::kSize, A::kSize>());
    b.add_point_curvature(n, -factor, hessian.template bottomRightCorner<B::kSize, B::kSize>());

    const int count_a = points.slide_count_a, count = count_a + points.slide_count_b;
    if (count == 0) {
        const Vec3 tangent = n.unitOrthogonal();
        add_square(relative_row(a, b, tangent), factor / d, hessian);
        add_square(relative_row(a, b, n.cross(tangent)), factor / d, hessian);
        return;
    }
    std::array<Vec3, 2> S;
    std::array<Vector<A::kSlideSize>, 2> q_a;
    std::array<Vector<B::kSlideSize>, 2> q_b;
    Eigen::Matrix<double, kSize, 2> P = Eigen::Matrix<double, kSize, 2>::Zero();  // its columns SᵀW + ½ d q
    for (int k = 0; k < count; ++k) {
        if (k < count_a) {
            S[k] = points.slide_a[k];
            q_a[k] = a.slide(k, S[k], n);
            P.col(k) = relative_row(a, b, S[k]);
            P.col(k).template head<A::kSlideSize>() += 0.5 * d * q_a[k];
        } else {
            S[k] = -points.slide_b[k - count_a];
            q_b[k] = -b.slide(k - count_a, points.slide_b[k - count_a], n);
            P.col(k) = relative_row(a, b, S[k]);
            P.col(k).template segment<B::kSlideSize>(A::kSize) += 0.5 * d * q_b[k];
        }
    }
    Eigen::Matrix2d G = Eigen::Matrix2d::Identity();
    if (count == 1) {
        add_square(relative_row(a, b, n.cross(S[0])), factor / d, hessian);
    } else if (count_a == 1) {  // one of each edge; those of a patch are orthonormal
        const double g = S[0].dot(S[1]);
        G << 1.0, -g, -g, 1.0;
        G /= S[0].cross(S[1]).squaredNorm();
    }
    for (int k = 0; k < count; ++k) {
        const Vector<kSize> PG = -factor * (G(0, k) * P.col(0) + G(1, k) * P.col(1));
        if (k < count_a)
            add_symmetric(PG, q_a[k], 0, hessian);
        else
            add_symmetric(PG, q_b[k], A::kSize, hessian);
    }
}

/// The squared sine c = 1 - g² of the angle between two edges, g the cosine, and its derivatives.
template <int N>
struct AngleDerivatives {
    Vector<N> gradient;
    Square<N> hessian;
};

template <class A, class B>
AngleDerivatives<A::kSize + B::kSize> angle_derivatives(const ContactGeometry& geometry, const A& a, const B& b) {
    constexpr int kA = A::kSize, kB = B::kSize;
    const Vec3 &da = geometry.direction_a, &db = geometry.direction_b;
    const double g = da.dot(db);
    const Rows3<kA> Da = a.direction(da);
    const Rows3<kB> Db = b.direction(db);
    Vector<kA + kB> g_gradient;
    g_gradient << Da.transpose() * db, Db.transpose() * da;
    Square<kA + kB> g_hessian;
    const Eigen::Matrix<double, kA, kB> cross = Da.transpose().lazyProduct(Db);
    g_hessian << a.direction_curvature(da, db), cross, cross.transpose(), b.direction_curvature(db, da);
    return {-2.0 * g * g_gradient, -2.0 * (g_gradient * g_gradient.transpose() + g * g_hessian)};
}

/// Rates of a triangle's barycentric coordinates along a direction in its plane.
Vec3 barycentric_rates(const Vec3& e1, const Vec3& e2, const Vec3& direction) {
    const double g11 = e1.squaredNorm(), g12 = e1.dot(e2), g22 = e2.squaredNorm();
    const double r1 = e1.dot(direction), r2 = e2.dot(direction);
    const double determinant = e1.cross(e2).squaredNorm();
    const double b1 = (g22 * r1 - g12 * r2) / determinant, b2 = (g11 * r2 - g12 * r1) / determinant;
    return {-b1 - b2, b1, b2};
}

}  // namespace

ClothSide cloth_side(const Contact& contact, const ContactGeometry& geometry, const Surface& cloth, bool of_a) {
    ClothSide side;
    const ClosestPoints& points = geometry.closest;
    const Vec3& point = of_a ? points.point_a : points.point_b;
    const int slide_count = of_a ? points.slide_count_a : points.slide_count_b;
    const std::array<Vec3, 2>& slides = of_a ? points.slide_a : points.slide_b;
    const std::array<int, 3> v = feature_vertices(*cloth.mesh, contact, of_a);
    if (v[1] < 0) {
        side.weights[0] = 1.0;
        return side;
    }
    // A segment: the edge, or the side of the triangle that is nearest. The code says which (see geometry/distance).
    int i = 0, j = 1, code;
    if (v[2] < 0) {
        code = static_cast<int>(of_a ? points.feature_code / 3 : points.feature_code % 3);
        side.edge_length = (cloth.vertex(v[1]) - cloth.vertex(v[0])).norm();
    } else if (points.feature_code != 0) {
        i = static_cast<int>(points.feature_code - 1) / 3;
        j = (i + 1) % 3;
        code = static_cast<int>(points.feature_code - 1) % 3;
    } else {
        const Vec3 x0 = cloth.vertex(v[0]), e1 = cloth.vertex(v[1]) - x0, e2 = cloth.vertex(v[2]) - x0;
        side.weights = Vec3::UnitX() + barycentric_rates(e1, e2, point - x0);
        for (int k = 0; k < slide_count; ++k) side.slide[k] = barycentric_rates(e1, e2, slides[k]);
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

template <class A, class B>
Vector<A::kSize + B::kSize> distance_gradient(const ContactGeometry& geometry, const A& a, const B& b) {
    return relative_row(
        motion_of(a, geometry.closest.point_a), motion_of(b, geometry.closest.point_b), geometry.normal);
}

double contact_energy(const ContactGeometry& geometry, const ContactRange& range, double stiffness) {
    const double compression = range.rest - geometry.distance;
    if (!(compression > 0.0)) return 0.0;
    const double energy = contact_potential(compression, range.rest - range.pole, stiffness).energy;
    if (geometry.sine_sq >= kParallelLimit) return energy;
    // Exactly parallel edges have no energy however close they are: vertex-patch pairs hold them apart.
    return geometry.sine_sq > 0.0 ? edge_mollifier(geometry.sine_sq).value * energy : 0.0;
}

namespace {

template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> derivatives_along(
    const ContactGeometry& geometry, const ContactRange& range, double stiffness, const A& a, const B& b,
    bool with_hessian, bool with_curvature) {
    constexpr int kSize = A::kSize + B::kSize;
    ContactDerivatives<kSize> result;
    result.row = relative_row(a, b, geometry.normal);
    const PotentialValue potential =
        contact_potential(range.rest - geometry.distance, range.rest - range.pole, stiffness);
    const bool mollified = geometry.sine_sq < kParallelLimit;
    const Mollifier mollifier = mollified ? edge_mollifier(geometry.sine_sq) : Mollifier{1.0, 0.0, 0.0};
    result.force = mollifier.value * potential.force;
    result.stiffness = mollifier.value * potential.stiffness;
    result.gradient = -result.force * result.row;
    AngleDerivatives<kSize> angle;
    if (mollified) {
        angle = angle_derivatives(geometry, a, b);
        result.gradient += potential.energy * mollifier.first * angle.gradient;
    }
    if (!with_hessian) return result;
    result.hessian.noalias() = (result.stiffness * result.row) * result.row.transpose();
    if (!with_curvature) return result;
    if (result.force != 0.0) add_distance_hessian(geometry, a, b, -result.force, result.hessian);
    if (mollified) {
        const Square<kSize> cross = result.row * angle.gradient.transpose();
        result.hessian -= potential.force * mollifier.first * (cross + cross.transpose());
        result.hessian += potential.energy * (mollifier.second * (angle.gradient * angle.gradient.transpose()) +
                                              mollifier.first * angle.hessian);
    }
    return result;
}

/// From (turn of a, turn of b, shift of b) to both twists: a shift of a is the opposite shift of b.
ContactDerivatives<12> both_twists(const ContactDerivatives<9>& relative, bool with_hessian) {
    constexpr std::array<int, 4> kFrom = {0, 6, 3, 6};  // where the turns and shifts of a and of b come from
    constexpr std::array<double, 4> kSign = {1.0, -1.0, 1.0, 1.0};
    ContactDerivatives<12> result;
    result.force = relative.force;
    result.stiffness = relative.stiffness;
    for (int i = 0; i < 4; ++i) {
        result.row.segment<3>(3 * i) = kSign[i] * relative.row.segment<3>(kFrom[i]);
        result.gradient.segment<3>(3 * i) = kSign[i] * relative.gradient.segment<3>(kFrom[i]);
        if (!with_hessian) continue;
        for (int j = 0; j < 4; ++j)
            result.hessian.block<3, 3>(3 * i, 3 * j) =
                kSign[i] * kSign[j] * relative.hessian.block<3, 3>(kFrom[i], kFrom[j]);
    }
    return result;
}

}  // namespace

template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_derivatives(
    const ContactGeometry& geometry, const ContactRange& range, double stiffness, const A& side_a, const B& side_b,
    bool with_hessian, bool with_curvature) {
    const Vec3 &point_a = geometry.closest.point_a, &point_b = geometry.closest.point_b;
    if constexpr (std::is_same_v<A, BodySide> && std::is_same_v<B, BodySide>)
        return both_twists(
            derivatives_along(
                geometry, range, stiffness, TurnMotion(side_a, point_a), BodyMotion(side_b, point_b), with_hessian,
                with_curvature),
            with_hessian);
    else
        return derivatives_along(
            geometry, range, stiffness, motion_of(side_a, point_a), motion_of(side_b, point_b), with_hessian,
            with_curvature);
}

GroundDerivatives ground_derivatives(
    double height, const Vec3& arm, const ContactRange& range, double stiffness, bool with_hessian,
    bool with_curvature) {
    const PotentialValue potential = contact_potential(range.rest - height, range.rest - range.pole, stiffness);
    GroundDerivatives result;
    result.force = potential.force;
    result.stiffness = potential.stiffness;
    result.row << arm.y(), -arm.x(), 0.0, 0.0, 0.0, 1.0;
    if (!with_hessian) return result;
    result.hessian.setZero();
    for (int i : {0, 1, 5})
        for (int j : {0, 1, 5}) result.hessian(i, j) = potential.stiffness * result.row[i] * result.row[j];
    if (with_curvature) result.hessian.topLeftCorner<3, 3>() -= potential.force * turn_curvature(arm, Vec3::UnitZ());
    return result;
}

// The pairs of sides there are.
#define DIFFSIM_INSTANTIATE(A, B)                                                                       \
    template Vector<A::kSize + B::kSize> distance_gradient(const ContactGeometry&, const A&, const B&); \
    template ContactDerivatives<A::kSize + B::kSize> contact_derivatives(                               \
        const ContactGeometry&, const ContactRange&, double, const A&, const B&, bool, bool);
DIFFSIM_INSTANTIATE(BodySide, BodySide)
DIFFSIM_INSTANTIATE(BodySide, ClothSide)
DIFFSIM_INSTANTIATE(ClothSide, ClothSide)
#undef DIFFSIM_INSTANTIATE

}  // namespace diffsim
