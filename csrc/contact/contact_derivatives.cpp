#include "contact/contact_derivatives.hpp"

#include <Eigen/LU>
#include <cmath>

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

/// How the coordinates of a rigid body move the closest point on it and the directions of its features.
class BodyMotion {
public:
    static constexpr int kSize = 6;
    BodyMotion(const BodySide& side, const Vec3& point) : m_arm(point - side.center) {}

    Vec6 row(const Vec3& n) const {
        Vec6 result;
        result << m_arm.cross(n), n;
        return result;
    }
    Rows3<6> point() const {
        Rows3<6> result;
        result << -skew(m_arm), Mat3::Identity();
        return result;
    }
    /// n · d²(point).
    Mat6 point_curvature(const Vec3& n) const {
        Mat6 result = Mat6::Zero();
        result.topLeftCorner<3, 3>() = turn_curvature(m_arm, n);
        return result;
    }
    /// n · d(slide direction k).
    Vec6 slide(int, const Vec3& direction, const Vec3& n) const {
        Vec6 result = Vec6::Zero();
        result.head<3>() = direction.cross(n);
        return result;
    }
    /// d(unit direction of an edge).
    Rows3<6> direction(const Vec3& unit) const {
        Rows3<6> result = Rows3<6>::Zero();
        result.leftCols<3>() = -skew(unit);
        return result;
    }
    /// other · d²(unit direction of an edge).
    Mat6 direction_curvature(const Vec3& unit, const Vec3& other) const {
        Mat6 result = Mat6::Zero();
        result.topLeftCorner<3, 3>() = turn_curvature(unit, other);
        return result;
    }

private:
    Vec3 m_arm;
};

/// The same for the nodes of a cloth's feature.
class ClothMotion {
public:
    static constexpr int kSize = 9;
    ClothMotion(const ClothSide& side, const Vec3&) : m_side(side) {}

    Vector<9> row(const Vec3& n) const { return weighted(m_side.weights, n); }
    Rows3<9> point() const {
        Rows3<9> result;
        result << m_side.weights[0] * Mat3::Identity(), m_side.weights[1] * Mat3::Identity(),
            m_side.weights[2] * Mat3::Identity();
        return result;
    }
    Square<9> point_curvature(const Vec3&) const { return Square<9>::Zero(); }
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

/// The directions in which the closest points slide, as motions of their offset w = point_a - point_b, and how the
/// coordinates change them along n.
template <int N>
struct Slides {
    int count = 0;
    std::array<Vec3, 2> direction;    ///< dw/ds
    std::array<Vector<N>, 2> change;  ///< n · d(dw/ds)/d(coordinates)
};

template <class A, class B>
Slides<A::kSize + B::kSize> collect_slides(const ContactGeometry& geometry, const A& a, const B& b) {
    constexpr int kSize = A::kSize + B::kSize;
    const ClosestPoints& points = geometry.closest;
    Slides<kSize> slides;
    for (int k = 0; k < points.slide_count_a; ++k) {
        slides.direction[slides.count] = points.slide_a[k];
        slides.change[slides.count] << a.slide(k, points.slide_a[k], geometry.normal), Vector<B::kSize>::Zero();
        ++slides.count;
    }
    for (int k = 0; k < points.slide_count_b; ++k) {
        slides.direction[slides.count] = -points.slide_b[k];
        slides.change[slides.count] << Vector<A::kSize>::Zero(), -b.slide(k, points.slide_b[k], geometry.normal);
        ++slides.count;
    }
    return slides;
}

/// Second derivative of the distance d = min over the slides s of |w(y, s)|. With W = dw/dy, S = dw/ds, G = (SᵀS)⁻¹,
/// q = n · dS/dy, and N the projector on what is orthogonal to S and n:
///     WᵀNW/d - WᵀSGq - (WᵀSGq)ᵀ - d qᵀGq + n · d²w/dy²  =  WᵀNW/d - X - Xᵀ + n · d²w/dy²,  X = (SᵀW + ½ d q)ᵀ G q.
/// Products of these sizes are written out: what Eigen would call for them is made for large matrices, and allocates.
template <class A, class B>
Square<A::kSize + B::kSize> distance_hessian(const ContactGeometry& geometry, const A& a, const B& b) {
    constexpr int kSize = A::kSize + B::kSize;
    const Vec3& n = geometry.normal;
    const double d = geometry.distance;
    Rows3<kSize> W;
    W << a.point(), -b.point();

    Square<kSize> hessian = Square<kSize>::Zero();
    hessian.template topLeftCorner<A::kSize, A::kSize>() = a.point_curvature(n);
    hessian.template bottomRightCorner<B::kSize, B::kSize>() = -b.point_curvature(n);

    const Slides<kSize> slides = collect_slides(geometry, a, b);
    if (slides.count == 0) {
        const Mat3 N = Mat3::Identity() - n * n.transpose();
        const Rows3<kSize> NW = N * W;
        hessian.noalias() += W.transpose().lazyProduct(NW / d);
        return hessian;
    }
    Eigen::Matrix<double, 2, kSize> q = Eigen::Matrix<double, 2, kSize>::Zero();
    Eigen::Matrix<double, 2, kSize> SW = Eigen::Matrix<double, 2, kSize>::Zero();
    for (int k = 0; k < slides.count; ++k) {
        q.row(k) = slides.change[k];
        SW.row(k) = slides.direction[k].transpose() * W;
    }
    Eigen::Matrix2d G = Eigen::Matrix2d::Identity();
    if (slides.count == 1) {
        const Vec3 binormal = n.cross(slides.direction[0]);
        const Eigen::Matrix<double, 1, kSize> BW = binormal.transpose() * W;
        hessian.noalias() += (BW / d).transpose().lazyProduct(BW);
    } else {
        const double g = slides.direction[0].dot(slides.direction[1]);
        const double determinant = slides.direction[0].cross(slides.direction[1]).squaredNorm();
        G << 1.0, -g, -g, 1.0;
        G /= determinant;
    }
    const Eigen::Matrix<double, 2, kSize> P = SW + 0.5 * d * q, Gq = G * q;
    const Square<kSize> X = P.transpose().lazyProduct(Gq);
    hessian -= X + X.transpose();
    return hessian;
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
    Vector<A::kSize + B::kSize> row;
    row << motion_of(a, geometry.closest.point_a).row(geometry.normal),
        -motion_of(b, geometry.closest.point_b).row(geometry.normal);
    return row;
}

double contact_energy(const ContactGeometry& geometry, const ContactRange& range, double stiffness) {
    const double compression = range.rest - geometry.distance;
    if (!(compression > 0.0)) return 0.0;
    const double energy = contact_potential(compression, range.rest - range.pole, stiffness).energy;
    if (geometry.sine_sq >= kParallelLimit) return energy;
    // Exactly parallel edges have no energy however close they are: vertex-patch pairs hold them apart.
    return geometry.sine_sq > 0.0 ? edge_mollifier(geometry.sine_sq).value * energy : 0.0;
}

template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_derivatives(
    const ContactGeometry& geometry, const ContactRange& range, double stiffness, const A& side_a, const B& side_b,
    bool with_hessian, bool with_curvature) {
    constexpr int kSize = A::kSize + B::kSize;
    const auto a = motion_of(side_a, geometry.closest.point_a);
    const auto b = motion_of(side_b, geometry.closest.point_b);
    ContactDerivatives<kSize> result;
    result.row << a.row(geometry.normal), -b.row(geometry.normal);
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
    result.hessian = result.stiffness * (result.row * result.row.transpose());
    if (!with_curvature) return result;
    if (result.force != 0.0) result.hessian -= result.force * distance_hessian(geometry, a, b);
    if (mollified) {
        const Square<kSize> cross = result.row * angle.gradient.transpose();
        result.hessian -= potential.force * mollifier.first * (cross + cross.transpose());
        result.hessian += potential.energy * (mollifier.second * (angle.gradient * angle.gradient.transpose()) +
                                              mollifier.first * angle.hessian);
    }
    return result;
}

GroundDerivatives ground_derivatives(
    double height, const Vec3& arm, const ContactRange& range, double stiffness, bool with_curvature) {
    const PotentialValue potential = contact_potential(range.rest - height, range.rest - range.pole, stiffness);
    GroundDerivatives result;
    result.force = potential.force;
    result.stiffness = potential.stiffness;
    result.row << arm.y(), -arm.x(), 0.0, 0.0, 0.0, 1.0;
    result.hessian.noalias() = (potential.stiffness * result.row) * result.row.transpose();
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
