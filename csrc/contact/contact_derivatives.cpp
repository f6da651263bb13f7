#include "contact/contact_derivatives.hpp"

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <type_traits>
#include <utility>

#include "math/rotation.hpp"

namespace diffsim {
namespace {

/// Add, times a factor, the second derivative of the distance d = min over the slides s of |w(y, s)|, of which a
/// closest point has as many as its count. With W = dw/dy, S = dw/ds, G = (SᵀS)⁻¹, q = n · dS/dy, and N the projector
/// on what is orthogonal to S and n:
///     WᵀNW/d - WᵀSGq - (WᵀSGq)ᵀ - d qᵀGq + n · d²w/dy²  =  WᵀNW/d - X - Xᵀ + n · d²w/dy²,  X = (SᵀW + ½ d q)ᵀ G q.
/// A slide of one object changes its direction with the coordinates of that object alone. All but n · d²w/dy² is added.
template <class A, class B>
void add_slide_hessian(
    const ContactGeometry& geometry, const A& a, const B& b, int count_a, int count_b, double factor,
    HalfSymmetric<A::kSize + B::kSize>& hessian) {
    constexpr int kSize = A::kSize + B::kSize;
    const Vec3& n = geometry.normal;
    const double d = geometry.distance;
    const auto add_tangent = [&](const Vec3& tangent) { hessian.add_square(factor / d, relative_row(a, b, tangent)); };
    const int count = count_a + count_b;
    if (count == 0) {
        const Vec3 tangent = n.unitOrthogonal();
        add_tangent(tangent);
        add_tangent(n.cross(tangent));
        return;
    }
    const std::array<Vec3, 2> slides_a = slide_directions(geometry.closest.a, n),
                              slides_b = slide_directions(geometry.closest.b, n);
    std::array<Vec3, 2> S;
    std::array<Vector<A::kTurnSize>, 2> q_a;
    std::array<Vector<B::kTurnSize>, 2> q_b;
    std::array<Vector<kSize>, 2> P;  // SᵀW + ½ d q
    P[1].setZero();
    for (int k = 0; k < count; ++k) {
        if (k < count_a) {
            S[k] = slides_a[k];
            q_a[k] = a.slide(k, S[k], n);
            P[k] = relative_row(a, b, S[k]);
            P[k].template head<A::kTurnSize>() += 0.5 * d * q_a[k];
        } else {
            S[k] = -slides_b[k - count_a];
            q_b[k] = -b.slide(k - count_a, slides_b[k - count_a], n);
            P[k] = relative_row(a, b, S[k]);
            P[k].template segment<B::kTurnSize>(A::kSize) += 0.5 * d * q_b[k];
        }
    }
    Eigen::Matrix2d G = Eigen::Matrix2d::Identity();
    if (count == 1) {
        add_tangent(n.cross(S[0]));
    } else if (count_a == 1) {  // one of each edge; those of a patch are orthonormal
        const double g = S[0].dot(S[1]);
        G << 1.0, -g, -g, 1.0;
        // The sine that the mollifier goes by: the cross product of unit vectors may round to zero where it does not.
        G /= geometry.sine_sq;
    }
    for (int k = 0; k < count; ++k) {
        const Vector<kSize> PG = -factor * (G(0, k) * P[0] + G(1, k) * P[1]);
        if (k < count_a)
            hessian.template add_outer<0, A::kTurnSize>(PG, q_a[k]);
        else
            hessian.template add_outer<A::kSize, B::kTurnSize>(PG, q_b[k]);
    }
}

/// The same, whole. On the border of its feature a point slides one way alone, and the second derivative is another one
/// on either side: their mean is taken. Where two equal edges lie side by side, an end of one leaves the other as an
/// end of that one comes onto it: the sum over the contacts is the same on both sides, and the sum of the means is it.
template <class A, class B>
void add_distance_hessian(
    const ContactGeometry& geometry, const A& a, const B& b, double factor,
    HalfSymmetric<A::kSize + B::kSize>& hessian) {
    if constexpr (!std::is_same_v<A, ClothMotion>)
        hessian.template block<3, 3>(0, 0) += (0.5 * factor) * a.point_curvature(geometry.normal);
    if constexpr (!std::is_same_v<B, ClothMotion>)
        hessian.template block<3, 3>(A::kSize, A::kSize) -= (0.5 * factor) * b.point_curvature(geometry.normal);
    const ClosestPoints& points = geometry.closest;
    const int count_a = points.a.slide_count, border_a = points.a.border_count;
    const int count_b = points.b.slide_count, border_b = points.b.border_count;
    if (border_a + border_b == 0) {
        add_slide_hessian(geometry, a, b, count_a, count_b, factor, hessian);
    } else {
        add_slide_hessian(geometry, a, b, count_a, count_b, 0.5 * factor, hessian);
        add_slide_hessian(geometry, a, b, count_a - border_a, count_b - border_b, 0.5 * factor, hessian);
    }
}

/// The squared sine c = 1 - g² of the angle between two edges, through their cosine g.
/// Shifts of bodies do not change it.
template <class A, class B>
struct Angle {
    static constexpr int kA = A::kTurnSize, kB = B::kTurnSize;
    const A& a;
    const B& b;
    Vec3 direction_a, direction_b;
    double cosine;
    Rows3<kA> turn_a;  ///< d(direction_a)
    Rows3<kB> turn_b;
    Vector<kA> gradient_a;  ///< of the cosine
    Vector<kB> gradient_b;

    Angle(const ContactGeometry& geometry, const A& motion_a, const B& motion_b)
        : a(motion_a),
          b(motion_b),
          direction_a(geometry.closest.a.edge.normalized()),
          direction_b(geometry.closest.b.edge.normalized()),
          cosine(direction_a.dot(direction_b)),
          turn_a(a.direction(direction_a)),
          turn_b(b.direction(direction_b)),
          gradient_a(turn_a.transpose() * direction_b),
          gradient_b(turn_b.transpose() * direction_a) {}

    /// Add v dgᵀ and its transpose.
    void add_outer(const Vector<A::kSize + B::kSize>& v, HalfSymmetric<A::kSize + B::kSize>& hessian) const {
        hessian.template add_outer<0, kA>(v, gradient_a);
        hessian.template add_outer<A::kSize, kB>(v, gradient_b);
    }
    /// Add, times a factor, d²g.
    void add_hessian(double factor, HalfSymmetric<A::kSize + B::kSize>& hessian) const {
        hessian.template block<kA, kA>(0, 0) += (0.5 * factor) * a.direction_curvature(direction_a, direction_b);
        hessian.template block<kB, kB>(A::kSize, A::kSize) +=
            (0.5 * factor) * b.direction_curvature(direction_b, direction_a);
        hessian.template block<kA, kB>(0, A::kSize) += factor * (turn_a.transpose() * turn_b);
    }
};

}  // namespace

double contact_energy(const ContactGeometry& geometry, const ContactLaw& law) {
    if (!(law.range.rest - geometry.distance > 0.0)) return 0.0;
    const double energy = normal_force(law, geometry.distance).energy;
    if (geometry.sine_sq >= kParallelLimit) return energy;
    // Exactly parallel edges have no energy however close they are: vertex-patch pairs hold them apart.
    return geometry.sine_sq > 0.0 ? edge_mollifier(geometry.sine_sq).value * energy : 0.0;
}

double contact_force(const ContactGeometry& geometry, const ContactLaw& law) {
    return edge_mollifier(geometry.sine_sq).value * normal_force(law, geometry.distance).force;
}

namespace {

/// The second derivative is added to `hessian`, unless that is null.
template <class A, class B>
ContactForce<A::kSize + B::kSize> derivatives_along(
    const ContactGeometry& geometry, const ContactLaw& law, const A& a, const B& b, bool with_curvature,
    HalfSymmetric<A::kSize + B::kSize>* hessian) {
    constexpr int kSize = A::kSize + B::kSize;
    ContactForce<kSize> result;
    result.row = relative_row(a, b, geometry.normal);
    const PotentialValue potential = normal_force(law, geometry.distance);
    const bool mollified = geometry.sine_sq < kParallelLimit;
    const Mollifier mollifier = mollified ? edge_mollifier(geometry.sine_sq) : Mollifier{1.0, 0.0, 0.0};
    result.force = mollifier.value * potential.force;
    result.stiffness = mollifier.value * potential.stiffness;
    result.gradient = -result.force * result.row;
    if (hessian != nullptr) {
        hessian->add_square(result.stiffness, result.row);
        if (with_curvature && result.force != 0.0) add_distance_hessian(geometry, a, b, -result.force, *hessian);
    }
    // An edge that has collapsed has no angle.
    const double shorter_sq = std::min(geometry.closest.a.edge.squaredNorm(), geometry.closest.b.edge.squaredNorm());
    if (!mollified || shorter_sq == 0.0) return result;
    // Mollifier mu(c), c = 1 - g², times potential: along dg, mu' = -2 g mu'(c) and mu'' = 4 g² mu''(c) - 2 mu'(c).
    const Angle<A, B> angle(geometry, a, b);
    const double g = angle.cosine, first = -2.0 * g * mollifier.first;
    const double second = 4.0 * g * g * mollifier.second - 2.0 * mollifier.first;
    Vector<kSize> gradient = Vector<kSize>::Zero();
    gradient.template head<A::kTurnSize>() = angle.gradient_a;
    gradient.template segment<B::kTurnSize>(A::kSize) = angle.gradient_b;
    result.gradient += (potential.energy * first) * gradient;
    if (hessian == nullptr || !with_curvature) return result;
    const Vector<kSize> along = (0.5 * potential.energy * second) * gradient - (potential.force * first) * result.row;
    angle.add_outer(along, *hessian);
    angle.add_hessian(potential.energy * first, *hessian);
    return result;
}

template <class A, class B>
ContactForce<A::kSize + B::kSize> curvature_along(
    const ContactGeometry& geometry, double force, const A& a, const B& b,
    HalfSymmetric<A::kSize + B::kSize>& hessian) {
    ContactForce<A::kSize + B::kSize> result;
    result.row = relative_row(a, b, geometry.normal);
    result.force = force;
    result.stiffness = 0.0;
    result.gradient = -force * result.row;
    add_distance_hessian(geometry, a, b, -force, hessian);
    return result;
}

// Where the turns and shifts of a and of b come from, and with which sign: a shift of a is the opposite shift of b.
constexpr std::array<int, 4> kRelativeFrom = {0, 6, 3, 6};
constexpr std::array<double, 4> kRelativeSign = {1.0, -1.0, 1.0, 1.0};

}  // namespace

ContactForce<9> add_relative_derivatives(
    const ContactGeometry& geometry, const ContactLaw& law, const BodySide& a, const BodySide& b, bool with_curvature,
    HalfSymmetric<9>* hessian) {
    return derivatives_along(
        geometry, law, TurnMotion(a, geometry.closest.a.point), BodyMotion(b, geometry.closest.b.point), with_curvature,
        hessian);
}

ContactForce<9> add_relative_curvature(
    const ContactGeometry& geometry, double force, const BodySide& a, const BodySide& b, HalfSymmetric<9>& hessian) {
    return curvature_along(
        geometry, force, TurnMotion(a, geometry.closest.a.point), BodyMotion(b, geometry.closest.b.point), hessian);
}

template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_curvature(
    const ContactGeometry& geometry, double force, const A& side_a, const B& side_b) {
    HalfSymmetric<A::kSize + B::kSize> hessian;
    ContactDerivatives<A::kSize + B::kSize> result;
    static_cast<ContactForce<A::kSize + B::kSize>&>(result) = curvature_along(
        geometry, force, motion_of(side_a, geometry.closest.a.point), motion_of(side_b, geometry.closest.b.point),
        hessian);
    result.hessian = hessian.whole();
    return result;
}

Vector<12> both_twists(const Vector<9>& relative) {
    Vector<12> result;
    for (int i = 0; i < 4; ++i) result.segment<3>(3 * i) = kRelativeSign[i] * relative.segment<3>(kRelativeFrom[i]);
    return result;
}

Square<12> both_twists(const Square<9>& relative) {
    Square<12> result;
    for (int i = 0; i < 4; ++i)
        for (int j = 0; j < 4; ++j)
            result.block<3, 3>(3 * i, 3 * j) =
                kRelativeSign[i] * kRelativeSign[j] * relative.block<3, 3>(kRelativeFrom[i], kRelativeFrom[j]);
    return result;
}

template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_derivatives(
    const ContactGeometry& geometry, const ContactLaw& law, const A& side_a, const B& side_b, bool with_hessian,
    bool with_curvature) {
    ContactDerivatives<A::kSize + B::kSize> result;
    if constexpr (std::is_same_v<A, BodySide> && std::is_same_v<B, BodySide>) {
        HalfSymmetric<9> hessian;
        const ContactForce<9> relative =
            add_relative_derivatives(geometry, law, side_a, side_b, with_curvature, with_hessian ? &hessian : nullptr);
        result.force = relative.force;
        result.stiffness = relative.stiffness;
        result.gradient = both_twists(relative.gradient);
        result.row = both_twists(relative.row);
        if (with_hessian) result.hessian = both_twists(hessian.whole());
    } else {
        HalfSymmetric<A::kSize + B::kSize> hessian;
        static_cast<ContactForce<A::kSize + B::kSize>&>(result) = derivatives_along(
            geometry, law, motion_of(side_a, geometry.closest.a.point), motion_of(side_b, geometry.closest.b.point),
            with_curvature, with_hessian ? &hessian : nullptr);
        if (with_hessian) result.hessian = hessian.whole();
    }
    return result;
}

Vec6 GroundSums::row(const Vec3& arm) {
    Vec6 row;
    row << arm.y(), -arm.x(), 0.0, 0.0, 0.0, 1.0;
    return row;
}

PotentialValue GroundSums::add(double height, const Vec3& arm, const ContactLaw& law) {
    const PotentialValue potential = normal_force(law, height);
    m_force += potential.force;
    m_force_arm += potential.force * arm;
    const double k = potential.stiffness, kx = k * arm.x(), ky = k * arm.y();
    m_moments[0] += k;
    m_moments[1] += kx;
    m_moments[2] += ky;
    m_moments[3] += kx * arm.x();
    m_moments[4] += kx * arm.y();
    m_moments[5] += ky * arm.y();
    return potential;
}

Vec6 GroundSums::gradient() const {
    Vec6 gradient;
    gradient << -m_force_arm.y(), m_force_arm.x(), 0.0, 0.0, 0.0, -m_force;
    return gradient;
}

Mat6 GroundSums::hessian(bool with_curvature) const {
    Mat6 hessian = Mat6::Zero();
    const auto set = [&](int i, int j, double value) { hessian(i, j) = hessian(j, i) = value; };
    set(0, 0, m_moments[5]);
    set(0, 1, -m_moments[4]);
    set(0, 5, m_moments[2]);
    set(1, 1, m_moments[3]);
    set(1, 5, -m_moments[1]);
    set(5, 5, m_moments[0]);
    if (with_curvature) hessian.topLeftCorner<3, 3>() -= turn_curvature(m_force_arm, Vec3::UnitZ());
    return hessian;
}

// The pairs of sides there are.
#define DIFFSIM_INSTANTIATE(A, B)                                         \
    template ContactDerivatives<A::kSize + B::kSize> contact_derivatives( \
        const ContactGeometry&, const ContactLaw&, const A&, const B&, bool, bool);
DIFFSIM_INSTANTIATE(BodySide, BodySide)
DIFFSIM_INSTANTIATE(BodySide, ClothSide)
DIFFSIM_INSTANTIATE(ClothSide, ClothSide)
#undef DIFFSIM_INSTANTIATE
template ContactDerivatives<15> contact_curvature(const ContactGeometry&, double, const BodySide&, const ClothSide&);
template ContactDerivatives<18> contact_curvature(const ContactGeometry&, double, const ClothSide&, const ClothSide&);

}  // namespace diffsim
