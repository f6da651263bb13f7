#include "zone/friction_term.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <type_traits>

#include "math/rotation.hpp"
#include "zone/chart.hpp"

namespace diffsim {
namespace {

/// How a contact changes, to first order, when its sides are elsewhere.
template <int kSize>
struct Changes {
    using Rates = Eigen::Matrix<double, 3, kSize>;
    using Rate = Eigen::Matrix<double, 1, kSize>;
    Rates point = Rates::Zero(), normal = Rates::Zero();            ///< where the surfaces meet; the normal
    Rate force = Rate::Zero();                                      ///< the contact's own
    std::array<Rates, 2> weights = {Rates::Zero(), Rates::Zero()};  ///< of cloth: of each side's three nodes
};
template <class A, class B>
using ChangesOf = Changes<A::kSize + B::kSize>;

/// d(closest point of the feature), its place on the feature held.
template <class Motion>
Eigen::Matrix<double, 3, Motion::kSize> material_rows(const Motion& motion) {
    Eigen::Matrix<double, 3, Motion::kSize> result;
    for (int i = 0; i < 3; ++i) result.row(i) = motion.row(Vec3::Unit(i)).transpose();
    return result;
}

/// One of the two sides in the place of a template's.
template <class Side>
struct Kind;
template <>
struct Kind<BodySide> {
    static constexpr bool is_body = true, is_cloth = false;
};
template <>
struct Kind<ClothSide> {
    static constexpr bool is_body = false, is_cloth = true;
};
template <>
struct Kind<GroundSide> {
    static constexpr bool is_body = false, is_cloth = false;
};

/// Adds what closest points and normal change by, where a's point has so many slides and b's so many: with w the offset
/// of the points, S its slides, W its change with the places and q = n · dS, the points stay closest where
///     Sᵀ (W δ + S σ) + d q δ = 0.
template <class A, class B>
void add_closest_changes(
    const ContactGeometry& geometry, const ContactLaw& law, const A& a, const B& b, int count_a, int count_b,
    double share, ChangesOf<A, B>& changes) {
    const auto motion_a = motion_of(a, geometry.closest.a.point);
    const auto motion_b = motion_of(b, geometry.closest.b.point);
    constexpr int kA = A::kSize, kB = B::kSize;
    using Rates = typename ChangesOf<A, B>::Rates;
    const Vec3& n = geometry.normal;
    const double d = geometry.distance;
    Rates Wa = Rates::Zero(), Wb = Rates::Zero();
    Wa.template leftCols<kA>() = material_rows(motion_a);
    Wb.template rightCols<kB>() = material_rows(motion_b);
    Rates W = Wa - Wb;
    const int count = count_a + count_b;
    if (count > 0) {
        const std::array<Vec3, 2> slides_a = slide_directions(geometry.closest.a, n),
                                  slides_b = slide_directions(geometry.closest.b, n);
        Eigen::Matrix<double, 3, Eigen::Dynamic, 0, 3, 4> S(3, count);
        using Slides = Eigen::Matrix<double, Eigen::Dynamic, kA + kB, 0, 4, kA + kB>;
        Slides right = Slides::Zero(count, kA + kB);
        for (int k = 0; k < count_a; ++k) {
            const Vec3& slide = slides_a[static_cast<std::size_t>(k)];
            S.col(k) = slide;
            const auto q = motion_a.slide(k, slide, n);
            right.row(k).head(q.size()) = d * q.transpose();
        }
        for (int k = 0; k < count_b; ++k) {
            const Vec3& slide = slides_b[static_cast<std::size_t>(k)];
            S.col(count_a + k) = -slide;
            const auto q = motion_b.slide(k, slide, n);
            right.row(count_a + k).segment(kA, q.size()) = -d * q.transpose();
        }
        right += S.transpose() * W;
        const Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, 4, 4> gram = S.transpose() * S;
        const Slides sigma = -gram.fullPivLu().solve(right);
        for (int k = 0; k < count_a; ++k) {
            Wa += slides_a[static_cast<std::size_t>(k)] * sigma.row(k);
            if constexpr (Kind<A>::is_cloth)
                changes.weights[0] += share * a.slide[static_cast<std::size_t>(k)] * sigma.row(k);
        }
        for (int k = 0; k < count_b; ++k) {
            Wb += slides_b[static_cast<std::size_t>(k)] * sigma.row(count_a + k);
            if constexpr (Kind<B>::is_cloth)
                changes.weights[1] += share * b.slide[static_cast<std::size_t>(k)] * sigma.row(count_a + k);
        }
        W += S * sigma;
    }
    changes.point += share * ((1.0 - law.margin_share) * Wa + law.margin_share * Wb);
    changes.normal += share / d * (W - n * (n.transpose() * W));
}

/// What the mollifier of nearly parallel edges changes by.
template <class A, class B>
typename ChangesOf<A, B>::Rate mollifier_change(const ContactGeometry& geometry, const A& a, const B& b) {
    typename ChangesOf<A, B>::Rate result = ChangesOf<A, B>::Rate::Zero();
    if (geometry.sine_sq >= kParallelLimit) return result;
    const auto motion_a = motion_of(a, geometry.closest.a.point);
    const auto motion_b = motion_of(b, geometry.closest.b.point);
    const Vec3 da = geometry.closest.a.edge.normalized(), db = geometry.closest.b.edge.normalized();
    const double first = -2.0 * da.dot(db) * edge_mollifier(geometry.sine_sq).first;
    const auto turn_a = motion_a.direction(da);
    const auto turn_b = motion_b.direction(db);
    result.head(turn_a.cols()) = first * db.transpose() * turn_a;
    result.segment(A::kSize, turn_b.cols()) = first * da.transpose() * turn_b;
    return result;
}

template <class A, class B>
ChangesOf<A, B> find_changes(const ContactGeometry& geometry, const ContactLaw& law, const A& a, const B& b) {
    ChangesOf<A, B> changes;
    const ClosestPoint &on_a = geometry.closest.a, &on_b = geometry.closest.b;
    const PotentialValue push = normal_force(law, geometry.distance);
    if constexpr (std::is_same_v<B, GroundSide>) {
        const auto W = material_rows(motion_of(a, on_a.point));
        changes.point = W;
        changes.point.row(2) *= 1.0 - law.margin_share;
        changes.force = -push.stiffness * W.row(2);
    } else {
        if (on_a.border_count + on_b.border_count == 0) {
            add_closest_changes(geometry, law, a, b, on_a.slide_count, on_b.slide_count, 1.0, changes);
        } else {  // one way alone: the mean of both sides, as of the distance's second derivative
            add_closest_changes(geometry, law, a, b, on_a.slide_count, on_b.slide_count, 0.5, changes);
            add_closest_changes(
                geometry, law, a, b, on_a.slide_count - on_a.border_count, on_b.slide_count - on_b.border_count, 0.5,
                changes);
        }
        const typename ChangesOf<A, B>::Rate distance =
            relative_row(motion_of(a, on_a.point), motion_of(b, on_b.point), geometry.normal).transpose();
        changes.force = -edge_mollifier(geometry.sine_sq).value * push.stiffness * distance +
                        push.force * mollifier_change(geometry, a, b);
    }
    return changes;
}

/// Puts the term together, side by side.
template <class A, class B>
class TermMaker {
public:
    TermMaker(
        const Zone& zone, const ZonePoint& point, const ZoneContact& contact, const ContactGeometry& geometry,
        double force, const ContactFriction& friction, FrictionTerm& term)
        : m_zone(zone),
          m_point(point),
          m_geometry(geometry),
          m_contact(contact),
          m_pushed(force),
          m_friction(friction),
          m_term(term),
          m_frame(friction_frame(geometry, contact.law)) {}

    void make(const PlacedSide<A>& placed_a, const PlacedSide<B>& placed_b) {
        set_side(m_term.sides[0], placed_a);
        set_side(m_term.sides[1], placed_b);
        m_term.sides[1].offset = A::kSize;
        m_term.side_count = std::is_same_v<B, GroundSide> ? 1 : 2;
        if constexpr (std::is_same_v<B, GroundSide>)
            m_changes = find_changes(m_geometry, m_contact.law, placed_a.side, GroundSide());
        else
            m_changes = find_changes(m_geometry, m_contact.law, placed_a.side, placed_b.side);
        add_motion<0>(placed_a, 1.0);
        add_motion<A::kSize>(placed_b, -1.0);
        find_slip();
        find_force();
        m_term.rows.resize(kSize, 2);
        m_term.force = SmallVector::Zero(kSize);
        add_force<0>(placed_a, 1.0);
        add_force<A::kSize>(placed_b, -1.0);
        put_together(placed_a, placed_b);
    }

private:
    static constexpr int kSize = A::kSize + B::kSize;
    using Rates = Eigen::Matrix<double, 3, kSize>;
    using Square = Eigen::Matrix<double, kSize, kSize>;

    const Vec3& normal() const { return m_geometry.normal; }
    Vec6 motion_of(const PlacedSide<BodySide>& side) const {
        return side.yields ? m_point.y.bodies[side.body] : m_zone.bodies[side.body].target;
    }

    // --- relative motion of the material points that meet: v

    template <int kOffset>
    void add_motion(const PlacedSide<BodySide>& placed, double sign) {
        const Vec6 y = motion_of(placed);
        const Vec3 arm = m_frame.point - placed.side.center, turn = y.head<3>();
        m_motion += sign * (y.tail<3>() + turn.cross(arm));
        m_motion_of_place += sign * skew(turn) * m_changes.point;
        m_motion_of_place.template middleCols<3>(kOffset + 3) -= sign * skew(turn);
        m_motion_of_motion.template middleCols<3>(kOffset) -= sign * skew(arm);
        m_motion_of_motion.template middleCols<3>(kOffset + 3) += sign * Mat3::Identity();
    }
    template <int kOffset>
    void add_motion(const PlacedSide<ClothSide>& placed, double sign) {
        for (int k = 0; k < 3; ++k) {
            const int node = placed.nodes[static_cast<std::size_t>(k)];
            if (node < 0) continue;
            const ZoneNode& of_zone = m_zone.nodes[node];
            const Vec3& y = of_zone.pinned ? of_zone.target : m_point.y.nodes[node];
            m_motion += sign * placed.side.weights[k] * y;
            m_motion_of_place += sign * y * m_changes.weights[kOffset == 0 ? 0 : 1].row(k);
            m_motion_of_motion.template middleCols<3>(kOffset + 3 * k) +=
                sign * placed.side.weights[k] * Mat3::Identity();
        }
    }
    template <int kOffset>
    void add_motion(const PlacedSide<GroundSide>&, double) {}

    /// s = P v, P the projection along the normal.
    void find_slip() {
        const Vec3& n = normal();
        const double along = n.dot(m_motion);
        const Mat3 P = Mat3::Identity() - n * n.transpose();
        m_slip = P * m_motion;
        m_slip_of_place =
            P * m_motion_of_place - along * m_changes.normal - n * (m_motion.transpose() * m_changes.normal);
        m_slip_of_motion = P * m_motion_of_motion;
    }

    /// λ and its derivatives.
    void find_force() {
        const ContactLaw& law = m_contact.law;
        const double mollifier = edge_mollifier(m_geometry.sine_sq).value;
        const PotentialValue push = normal_force(law, m_geometry.distance);
        const double bound = law.friction * m_pushed, size = m_slip.norm();
        m_term.sticks = !(m_friction.slips && size > kRestingSlip);
        m_term.stiffness = mollifier * push.stiffness;
        m_term.symmetric.setZero();
        const Vec3& n = normal();
        if (m_term.sticks) {
            m_force = bound * (m_friction.share - n * n.dot(m_friction.share));
            m_force_of_place = -n * (m_force.transpose() * m_changes.normal);
            m_force_of_motion.setZero();
            Eigen::Matrix<double, 2, 3> T;
            T << m_frame.tangents[0].transpose(), m_frame.tangents[1].transpose();
            m_term.slip_of_place = T * m_slip_of_place;
            m_term.slip_of_motion = T * m_slip_of_motion;
            return;
        }
        const Vec3 along = m_slip / size;
        m_force = bound * along;
        const Mat3 turn = bound / size * (Mat3::Identity() - along * along.transpose());
        m_force_of_place = law.friction * along * m_changes.force + turn * m_slip_of_place;
        m_force_of_motion = turn * m_slip_of_motion;
        for (int k = 0; k < 2; ++k)
            for (int l = 0; l < 2; ++l)
                m_term.symmetric(k, l) = m_frame.tangents[static_cast<std::size_t>(k)].dot(
                    turn * m_frame.tangents[static_cast<std::size_t>(l)]);
    }

    // --- its forces on the coordinates

    template <int kOffset>
    void add_force(const PlacedSide<BodySide>& placed, double sign) {
        constexpr int o = kOffset;
        const Vec6 y = motion_of(placed);
        const Vec3 theta = y.head<3>(), arm = m_frame.point - placed.side.center;
        const Mat3 Jt = left_jacobian(theta).transpose();
        Rates arm_of_place = m_changes.point;
        arm_of_place.template middleCols<3>(o + 3) -= Mat3::Identity();
        const Vec3 torque = arm.cross(m_force);
        m_force_on_place.template middleRows<3>(o) +=
            sign * Jt * (skew(arm) * m_force_of_place - skew(m_force) * arm_of_place);
        m_force_on_place.template middleRows<3>(o + 3) += sign * m_force_of_place;
        m_force_on_motion.template middleRows<3>(o) += sign * Jt * skew(arm) * m_force_of_motion;
        m_force_on_motion.template middleRows<3>(o + 3) += sign * m_force_of_motion;
        m_force_on_motion.template block<3, 3>(o, o) += sign * left_jacobian_transposed_derivative(theta, torque);
        for (int k = 0; k < 2; ++k) {
            const Vec3& tangent = m_frame.tangents[static_cast<std::size_t>(k)];
            m_term.rows.col(k).segment<3>(o) = sign * Jt * arm.cross(tangent);
            m_term.rows.col(k).segment<3>(o + 3) = sign * tangent;
        }
        if (m_term.sticks) return;
        m_term.force.segment<3>(o) = sign * Jt * torque;
        m_term.force.segment<3>(o + 3) = sign * m_force;
    }
    template <int kOffset>
    void add_force(const PlacedSide<ClothSide>& placed, double sign) {
        for (int k = 0; k < 3; ++k) {
            const int o = kOffset + 3 * k;
            const double weight = placed.side.weights[k];
            m_force_on_place.template middleRows<3>(o) +=
                sign * (m_force * m_changes.weights[kOffset == 0 ? 0 : 1].row(k) + weight * m_force_of_place);
            m_force_on_motion.template middleRows<3>(o) += sign * weight * m_force_of_motion;
            for (int t = 0; t < 2; ++t)
                m_term.rows.col(t).segment<3>(o) = sign * weight * m_frame.tangents[static_cast<std::size_t>(t)];
            if (!m_term.sticks) m_term.force.segment<3>(o) = sign * weight * m_force;
        }
    }
    template <int kOffset>
    void add_force(const PlacedSide<GroundSide>&, double) {}

    // --- along y, with which places move

    void put_together(const PlacedSide<A>& placed_a, const PlacedSide<B>& placed_b) {
        Square changes = m_force_on_place;
        Eigen::Matrix<double, 2, kSize> slip;
        if (m_term.sticks) slip = m_term.slip_of_place;
        const auto along_coordinates = [&](const auto& placed, auto offset) {
            if constexpr (std::is_same_v<std::decay_t<decltype(placed)>, PlacedSide<BodySide>>) {
                if (!placed.yields) return;
                const Mat6 chart = chart_jacobian(m_point.y.bodies[placed.body]);
                changes.template middleCols<6>(offset) = (changes.template middleCols<6>(offset) * chart).eval();
                if (m_term.sticks)
                    slip.template middleCols<6>(offset) = (slip.template middleCols<6>(offset) * chart).eval();
            }
        };
        along_coordinates(placed_a, std::integral_constant<int, 0>());
        along_coordinates(placed_b, std::integral_constant<int, A::kSize>());
        m_term.force_of_place = m_force_on_place;
        m_term.force_of_motion = m_force_on_motion;
        m_term.changes = changes + m_force_on_motion;
        if (m_term.sticks) m_term.slip = slip + m_term.slip_of_motion;
    }

    const Zone& m_zone;
    const ZonePoint& m_point;
    const ContactGeometry& m_geometry;
    const ZoneContact m_contact;
    const double m_pushed;  // the contact's own force
    const ContactFriction& m_friction;
    FrictionTerm& m_term;
    FrictionFrame m_frame;
    Changes<kSize> m_changes;
    Vec3 m_motion = Vec3::Zero(), m_slip, m_force;
    Rates m_motion_of_place = Rates::Zero(), m_motion_of_motion = Rates::Zero();
    Rates m_slip_of_place, m_slip_of_motion, m_force_of_place, m_force_of_motion;
    Square m_force_on_place = Square::Zero(), m_force_on_motion = Square::Zero();
};

/// What kind of side it is, for decltype.
template <class Side>
Side kind(const PlacedSide<Side>&);

}  // namespace

void make_friction_term(
    const Zone& zone, const ZonePoint& point, int contact, const ContactGeometry& geometry, double force,
    const ContactFriction& friction, FrictionTerm& term) {
    with_placed_sides(
        zone, zone.contacts[contact], geometry, point.poses, point.nodes, [&](const auto& a, const auto& b) {
            TermMaker<decltype(kind(a)), decltype(kind(b))>(
                zone, point, zone.contacts[contact], geometry, force, friction, term)
                .make(a, b);
        });
}

}  // namespace diffsim
