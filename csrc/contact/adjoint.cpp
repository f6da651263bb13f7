#include "contact/adjoint.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <Eigen/QR>
#include <cmath>

#include "math/rotation.hpp"

namespace diffsim {
namespace {

/// The free coordinates as one vector: bodies, then nodes that are not pinned.
class FreeCoordinates {
public:
    explicit FreeCoordinates(const Zone& zone) : m_zone(zone), m_size(6 * zone.dynamic_count) {
        for (const ZoneNode& node : zone.nodes) {
            m_rows.push_back(node.pinned ? -1 : m_size);
            if (!node.pinned) m_size += 3;
        }
    }
    Eigen::Index size() const { return m_size; }
    Eigen::Index row(int node) const { return m_rows[static_cast<std::size_t>(node)]; }  ///< -1 if pinned

    VectorX flatten(const Coordinates& y) const {
        VectorX x(m_size);
        for (int i = 0; i < m_zone.dynamic_count; ++i) x.segment<6>(6 * i) = y.bodies[i];
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (row(i) >= 0) x.segment<3>(row(i)) = y.nodes[i];
        return x;
    }
    Coordinates unflatten(const VectorX& x) const {
        Coordinates y;
        y.assign_zero(static_cast<std::size_t>(m_zone.dynamic_count), m_zone.nodes.size());
        for (int i = 0; i < m_zone.dynamic_count; ++i) y.bodies[i] = x.segment<6>(6 * i);
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (row(i) >= 0) y.nodes[i] = x.segment<3>(row(i));
        return y;
    }

private:
    const Zone& m_zone;
    Eigen::Index m_size;
    std::vector<Eigen::Index> m_rows;
};

constexpr int kMaxSize = 18;
using SmallVector = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, kMaxSize, 1>;
using SmallMatrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, kMaxSize, kMaxSize>;

/// The derivatives of an active contact and what they are taken along: one or two objects, each a body's twist (6) or the
/// nodes of a cloth's feature (9).
struct ContactTerm {
    struct Side {
        int body = kNobody;
        std::array<int, 3> nodes = {-1, -1, -1};
        int offset = 0;
    };
    std::array<Side, 2> sides;
    int side_count = 2;
    SmallVector row, gradient;
    SmallMatrix hessian;
    double stiffness;

    /// Call body_part(body, offset) and node_part(node, offset) for everything the term is taken along.
    template <class BodyPart, class NodePart>
    void for_each(const BodyPart& body_part, const NodePart& node_part) const {
        for (int s = 0; s < side_count; ++s) {
            const Side& side = sides[static_cast<std::size_t>(s)];
            if (side.body >= 0) {
                body_part(side.body, side.offset);
                continue;
            }
            for (int k = 0; k < 3; ++k) {
                const int node = side.nodes[static_cast<std::size_t>(k)];
                if (node >= 0) node_part(node, side.offset + 3 * k);
            }
        }
    }
};

/// The derivatives of one active contact of a zone.
class ContactTermMaker {
public:
    ContactTermMaker(const Zone& zone, const ZonePoint& point) : m_zone(zone), m_point(point) {}

    /// Curvature::none leaves the Hessian unset.
    ContactTerm operator()(const ActiveContact& active, Curvature curvature) const {
        const ZoneContact& contact = m_zone.contacts[active.index];
        ContactTerm term;
        if (contact.contact.with_ground()) {
            term.side_count = 1;
            if (contact.cloth_a >= 0)
                node_on_ground(contact, active, term);
            else
                body_on_ground(contact, active, term);
            return term;
        }
        if (contact.cloth_a >= 0)
            fill(
                contact, active, curvature, cloth(contact, active, true, term), cloth(contact, active, false, term),
                term);
        else if (contact.cloth_b >= 0)
            fill(contact, active, curvature, body(contact.a, 0, term), cloth(contact, active, false, term), term);
        else
            fill(contact, active, curvature, body(contact.a, 0, term), body(contact.b, 1, term), term);
        return term;
    }

private:
    BodySide body(int index, std::size_t side, ContactTerm& term) const {
        term.sides[side].body = index;
        return {m_point.poses[index].t};
    }
    ClothSide cloth(const ZoneContact& contact, const ActiveContact& active, bool of_a, ContactTerm& term) const {
        term.sides[of_a ? 0 : 1].nodes = feature_nodes(m_zone, contact, of_a);
        const Surface surface = of_a ? surface_a(m_zone, contact, m_point.poses, m_point.nodes)
                                     : surface_b(m_zone, contact, m_point.poses, m_point.nodes);
        return cloth_side(contact.contact, active.geometry, surface, of_a);
    }

    template <class A, class B>
    static void fill(
        const ZoneContact& contact, const ActiveContact& active, Curvature curvature, const A& a, const B& b,
        ContactTerm& term) {
        term.sides[1].offset = A::kSize;
        const bool with_hessian = curvature != Curvature::none;
        const auto d = contact_derivatives(
            active.geometry, contact.range, contact.stiffness.value, a, b, with_hessian,
            curvature != Curvature::dropped);
        term.row = d.row;
        term.gradient = d.gradient;
        if (with_hessian) term.hessian = d.hessian;
        term.stiffness = d.stiffness;
    }

    void body_on_ground(const ZoneContact& contact, const ActiveContact& active, ContactTerm& term) const {
        term.sides[0].body = contact.a;
        term.row = GroundContacts::row(active.geometry.closest.point_a - m_point.poses[contact.a].t);
        term.stiffness = contact_potential(
                             contact.range.rest - active.geometry.distance, contact.range.rest - contact.range.pole,
                             contact.stiffness.value)
                             .stiffness;
    }

    void node_on_ground(const ZoneContact& contact, const ActiveContact& active, ContactTerm& term) const {
        term.sides[0].nodes = feature_nodes(m_zone, contact, true);
        const PotentialValue potential = contact_potential(
            contact.range.rest - active.geometry.distance, contact.range.rest - contact.range.pole,
            contact.stiffness.value);
        term.row = Vec3::UnitZ();
        term.gradient = -potential.force * term.row;
        term.hessian = potential.stiffness * term.row * term.row.transpose();
        term.stiffness = potential.stiffness;
    }

    const Zone& m_zone;
    const ZonePoint& m_point;
};

/// The contacts as rows of the paper's J, in the free coordinates, and their stiffness.
struct Rows {
    MatrixX J;          // m x n
    VectorX stiffness;  // m [kg]
};

Rows collect_rows(const Zone& zone, const ZonePoint& point, const FreeCoordinates& free) {
    const ContactTermMaker make_term(zone, point);
    const Eigen::Index count = static_cast<Eigen::Index>(point.active.size());
    Rows rows{MatrixX::Zero(count, free.size()), VectorX(count)};
    for (Eigen::Index k = 0; k < count; ++k) {
        const ContactTerm term = make_term(point.active[static_cast<std::size_t>(k)], Curvature::none);
        rows.stiffness[k] = term.stiffness;
        term.for_each(
            [&](int body, int offset) {
                if (!zone.yields(body)) return;
                rows.J.block<1, 6>(k, 6 * body) =
                    term.row.segment<6>(offset).transpose() * chart_jacobian(point.y.bodies[body]);
            },
            [&](int node, int offset) {
                if (free.row(node) >= 0)
                    rows.J.block<1, 3>(k, free.row(node)) = term.row.segment<3>(offset).transpose();
            });
    }
    return rows;
}

Mat6 mass_matrix(const ZoneBody& body) {
    Mat6 mass = Mat6::Zero();
    mass.topLeftCorner<3, 3>() = body.inertia;
    mass.diagonal().tail<3>().setConstant(body.mass);
    return mass;
}

/// Inertia and elasticity of the cloths' free nodes.
MatrixX cloth_matrix(const Zone& zone, const ZonePoint& point, const FreeCoordinates& free, CutShare cut) {
    const Eigen::Index first = 6 * zone.dynamic_count, size = free.size() - first;
    MatrixX matrix = MatrixX::Zero(size, size);
    if (size == 0) return matrix;
    BlockSystem cloth;
    cloth.set_pattern(cloth_pattern(zone));
    cloth.set_zero();
    if (zone.elastic) add_elastic_hessian(zone, point, cut, cloth);
    for (int i = 0; i < zone.node_count(); ++i) {
        if (free.row(i) < 0) continue;
        const Eigen::Index r = free.row(i) - first;
        matrix.block<3, 3>(r, r) = cloth.node_diagonal(i) + zone.nodes[i].mass * Mat3::Identity();
    }
    const IndexPairs& pairs = cloth.pattern().node_pairs;
    for (std::size_t k = 0; k < pairs.size(); ++k) {
        const Eigen::Index r = free.row(pairs[k].first) - first, c = free.row(pairs[k].second) - first;
        if (r < 0 || c < 0) continue;
        matrix.block<3, 3>(r, c) = cloth.node_pair(static_cast<int>(k));
        matrix.block<3, 3>(c, r) = cloth.node_pair(static_cast<int>(k)).transpose();
    }
    return matrix;
}

/// With the exact elastic Hessian, or its projection where the exact one is not positive definite.
MatrixX cloth_matrix(const Zone& zone, const ZonePoint& point, const FreeCoordinates& free) {
    MatrixX cloth = cloth_matrix(zone, point, free, kNothingCut);
    if (cloth.rows() > 0 && cloth.llt().info() != Eigen::Success) cloth = cloth_matrix(zone, point, free, kAllCut);
    return cloth;
}

/// Of [ A  Jᵀ ; J  -1/stiffness ] [z; λ] = [v; 0], A inertia and elasticity [Qiao et al. 2020, Eq. 9, its constraint rows
/// softened]. λ is stiffness J z, but computed from that it would lose the digits by which J z is smaller than z.
struct KktSolution {
    Coordinates z;
    VectorX multipliers;
};

KktSolution solve_dense(
    const Zone& zone, const FreeCoordinates& free, const MatrixX& cloth, const Rows& rows,
    const Coordinates& upstream) {
    const Eigen::Index n = rows.J.cols(), m = rows.J.rows();
    MatrixX kkt = MatrixX::Zero(n + m, n + m);
    for (int i = 0; i < zone.dynamic_count; ++i) kkt.block<6, 6>(6 * i, 6 * i) = mass_matrix(zone.bodies[i]);
    kkt.block(6 * zone.dynamic_count, 6 * zone.dynamic_count, cloth.rows(), cloth.cols()) = cloth;
    kkt.topRightCorner(n, m) = rows.J.transpose();
    kkt.bottomLeftCorner(m, n) = rows.J;
    for (Eigen::Index k = 0; k < m; ++k) kkt(n + k, n + k) = -1.0 / rows.stiffness[k];
    VectorX rhs = VectorX::Zero(n + m);
    rhs.head(n) = free.flatten(upstream);
    const VectorX solution = kkt.partialPivLu().solve(rhs);
    return {free.unflatten(solution.head(n)), solution.tail(m)};
}

/// Cholesky factor of inertia and elasticity: 6x6 per body, one of all nodes.
class InertiaFactor {
public:
    InertiaFactor(const Zone& zone, const MatrixX& cloth) : m_bodies(zone.dynamic_count), m_cloth(cloth.llt()) {
        for (int i = 0; i < m_bodies; ++i) m_factors.push_back(mass_matrix(zone.bodies[i]).llt().matrixL());
    }
    /// Overwrite x by L⁻¹ x.
    template <class Matrix>
    void solve_lower(Matrix& x) const {
        for (int i = 0; i < m_bodies; ++i) {
            auto block = x.template middleRows<6>(6 * i);
            block = m_factors[static_cast<std::size_t>(i)].template triangularView<Eigen::Lower>().solve(block).eval();
        }
        if (m_cloth.rows() == 0) return;
        auto block = x.bottomRows(m_cloth.rows());
        block = m_cloth.matrixL().solve(block).eval();
    }
    /// Overwrite x by L⁻ᵀ x.
    void solve_upper(VectorX& x) const {
        for (int i = 0; i < m_bodies; ++i)
            m_factors[static_cast<std::size_t>(i)].triangularView<Eigen::Lower>().transpose().solveInPlace(
                x.segment<6>(6 * i));
        if (m_cloth.rows() == 0) return;
        auto block = x.tail(m_cloth.rows());
        block = m_cloth.matrixU().solve(block).eval();
    }

private:
    int m_bodies;
    std::vector<Mat6> m_factors;
    Eigen::LLT<MatrixX> m_cloth;
};

/// With B = stiffness^½ J L⁻ᵀ and Bᵀ P = Q R:  (I + Bᵀ B)⁻¹ = I - Q (I - (I + R Rᵀ)⁻¹) Qᵀ, whatever the rank of B, and
/// B (I + Bᵀ B)⁻¹ = P Rᵀ (I + R Rᵀ)⁻¹ Qᵀ.
KktSolution solve_qr(
    const FreeCoordinates& free, const InertiaFactor& factor, const Rows& rows, const Coordinates& upstream) {
    const Eigen::Index n = rows.J.cols(), m = rows.J.rows();
    VectorX v = free.flatten(upstream);
    factor.solve_lower(v);
    VectorX multipliers(m);
    if (m > 0) {
        const VectorX root = rows.stiffness.cwiseSqrt();
        MatrixX Bt = rows.J.transpose() * root.asDiagonal();
        factor.solve_lower(Bt);
        const Eigen::ColPivHouseholderQR<MatrixX> qr(Bt);
        const Eigen::Index rank = std::min(n, m);
        const MatrixX R = qr.matrixR().topRows(rank).template triangularView<Eigen::Upper>();
        const VectorX projected = (qr.householderQ().transpose() * v).head(rank);
        const MatrixX gram = MatrixX::Identity(rank, rank) + R * R.transpose();
        const VectorX kept = gram.llt().solve(projected);
        VectorX correction = VectorX::Zero(n);
        correction.head(rank) = projected - kept;
        v -= qr.householderQ() * correction;
        multipliers = root.cwiseProduct(qr.colsPermutation() * (R.transpose() * kept));
    }
    factor.solve_upper(v);
    return {free.unflatten(v), multipliers};
}

/// Hard contacts: J z = 0 with reactions r, H z + Jᵀ r = v, by proximal steps r += stiffness * J z on the system that
/// gives way. Every step leaves about a compliance's part; they end when z no longer changes, since a small J z alone
/// does not mean that z is right. Returns the reactions, the last step's left out: the soft contacts carry it.
template <typename SolveInPlace>
std::vector<double> harden(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, const SolveInPlace& solve_in_place,
    Coordinates& z) {
    constexpr int kMaxSteps = 30;
    constexpr double kTolerance = 1e-14;  // on the change of z, relative: rounding
    const ContactTermMaker make_term(zone, point);
    std::vector<ContactTerm> terms;
    for (const ActiveContact& active : point.active) terms.push_back(make_term(active, Curvature::none));
    std::vector<double> reactions(terms.size(), 0.0);
    for (int step = 0; step < kMaxSteps; ++step) {
        std::vector<double> next = reactions;
        Coordinates rhs = upstream;
        for (std::size_t k = 0; k < terms.size(); ++k) {
            const ContactTerm& term = terms[k];
            double along = 0.0;
            term.for_each(
                [&](int body, int offset) {
                    if (zone.yields(body))
                        along += term.row.segment<6>(offset).dot(chart_jacobian(point.y.bodies[body]) * z.bodies[body]);
                },
                [&](int node, int offset) { along += term.row.segment<3>(offset).dot(z.nodes[node]); });
            next[k] += term.stiffness * along;
            term.for_each(
                [&](int body, int offset) {
                    if (zone.yields(body))
                        rhs.bodies[body] -=
                            next[k] * (chart_jacobian(point.y.bodies[body]).transpose() * term.row.segment<6>(offset));
                },
                [&](int node, int offset) {
                    if (!zone.nodes[node].pinned) rhs.nodes[node] -= next[k] * term.row.segment<3>(offset);
                });
        }
        solve_in_place(rhs);
        const Coordinates& better = rhs;
        double change = 0.0, size = 0.0;
        const auto compare = [&](const auto& now, const auto& before) {
            for (std::size_t i = 0; i < now.size(); ++i) {
                change = std::max(change, (now[i] - before[i]).norm());
                size = std::max(size, now[i].norm());
            }
        };
        compare(better.bodies, z.bodies);
        compare(better.nodes, z.nodes);
        z = better;
        reactions = next;
        if (change <= kTolerance * size) break;
    }
    return reactions;
}

/// Overwrite the upstream gradient by z. Returns the reactions of contacts, if they are hard.
template <typename SolveInPlace>
std::vector<double> solve(
    const Zone& zone, const ZonePoint& point, Coordinates& z, const SolveInPlace& solve_in_place) {
    const Coordinates upstream = zone.hard ? z : Coordinates();
    solve_in_place(z);
    return zone.hard ? harden(zone, point, upstream, solve_in_place, z) : std::vector<double>();
}

/// What the contacts of a body that yields take of the upstream gradient v, along its twist J dy at the end of the step.
/// With H = M + C + Jᵀ K J the matrix of  H z = v,  K of the contacts and C the curvature of the chart under their torque:
///     K J z + Jᵀ⁻¹ (M + C) z = Jᵀ⁻¹ v.
/// Of hard contacts, whose reactions stand beside H z, they are part of it.
Vec6 contact_share(const ZoneBody& body, const Vec6& y, const Vec3& torque, const Vec6& v, const Vec6& z) {
    Vec6 share = v;
    share.head<3>() -= body.inertia * z.head<3>();
    share.tail<3>() -= body.mass * z.tail<3>();
    const Vec3 theta = y.head<3>();
    if (theta.isZero(0.0)) return share;
    if (!torque.isZero(0.0)) share.head<3>() -= chart_curvature(y, torque) * z.head<3>();
    // J has no inverse at a full turn, where no chart is left: with pivots the answer stays finite.
    const Mat3 J = left_jacobian(theta);
    share.head<3>() = J.transpose().fullPivLu().solve(share.head<3>()).eval();
    return share;
}

/// What contacts add to the gradients of masses through their stiffness, between bodies and with the ground.
void add_body_stiffness(
    const Zone& zone, const std::vector<BodyContacts>& contacts, const std::vector<Vec6>& twist, ZoneAdjoint& result) {
    for (const BodyContacts& c : contacts) {
        double along = 0.0;
        for (const auto& [body, part] : {std::pair<int, Vec6>(c.a, c.gradient.head<6>()), {c.b, c.gradient.tail<6>()}})
            if (zone.yields(body)) along += part.dot(twist[body]);
        if (zone.yields(c.a)) result.mass_gradient[c.a] -= along * c.stiffness.log_gradient_a;
        if (zone.yields(c.b)) result.mass_gradient[c.b] -= along * c.stiffness.log_gradient_b;
    }
}

/// What contacts add to the gradients: to those of places that the linear system has no rows for, `twist` times their
/// second derivatives and the reactions of hard ones; with cloth, to those of masses, through their stiffness.
/// `multipliers`: stiffness times what opens each contact along `twist`, where contacts are rows of constant direction;
/// null where they have curvature.
void add_contacts(
    const Zone& zone, const ZonePoint& point, const VectorX* multipliers, const GradientNeeds& needs,
    const std::vector<Vec6>& twist, const std::vector<double>& reactions, ZoneAdjoint& result) {
    const ContactTermMaker make_term(zone, point);
    for (std::size_t k = 0; k < point.active.size(); ++k) {
        const ActiveContact& active = point.active[k];
        const ZoneContact& contact = zone.contacts[active.index];
        const bool of_bodies = zone.yields(contact.a) && (contact.contact.with_ground() || zone.yields(contact.b));
        const bool with_place = needs.place && !of_bodies;
        // A hard contact's stiffness is only how its multiplier was found.
        const bool through_stiffness = needs.mass && !zone.hard && (contact.cloth_a >= 0 || contact.cloth_b >= 0);
        if (!with_place && !through_stiffness) continue;
        const ContactTerm term =
            make_term(active, with_place && multipliers == nullptr ? Curvature::full : Curvature::none);
        SmallVector motion = SmallVector::Zero(term.row.size());
        term.for_each(
            [&](int body, int offset) { motion.segment<6>(offset) = twist[body]; },
            [&](int node, int offset) { motion.segment<3>(offset) = result.multiplier.nodes[node]; });
        if (with_place) {
            SmallVector gradient;
            if (multipliers == nullptr)
                gradient = term.hessian.lazyProduct(motion);  // of this size a library call is slower
            else
                gradient = (*multipliers)[static_cast<Eigen::Index>(k)] * term.row;
            if (zone.hard) gradient += reactions[k] * term.row;
            term.for_each(
                [&](int body, int offset) {
                    if (!zone.yields(body)) result.place_gradient.bodies[body] -= gradient.segment<6>(offset);
                },
                [&](int node, int offset) { result.place_gradient.nodes[node] -= gradient.segment<3>(offset); });
        }
        if (!through_stiffness) continue;
        const double along = term.gradient.dot(motion);
        for (std::size_t s = 0; s < static_cast<std::size_t>(term.side_count); ++s) {
            const double part = -along * (s == 0 ? contact.stiffness.log_gradient_a : contact.stiffness.log_gradient_b);
            if (zone.yields(term.sides[s].body)) result.mass_gradient[term.sides[s].body] += part;
            for (int node : term.sides[s].nodes)
                if (node >= 0) result.node_mass_gradient[node] += part;
        }
    }
}

/// What elasticity adds to the gradients: z times its second derivatives.
void add_elasticity(const Zone& zone, const ZonePoint& point, const GradientNeeds& needs, ZoneAdjoint& result) {
    const double scale = -zone.dt * zone.dt;
    std::vector<Vec3> start;
    for (const ZoneNode& node : zone.nodes) start.push_back(node.start);
    for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c) {
        const ZoneCloth& part = zone.cloths[c];
        const ClothParameters& parameters = (*zone.cloth_parameters)[part.id];
        const Vec3* x = point.nodes.data() + part.first_node;
        const Vec3* z = result.multiplier.nodes.data() + part.first_node;
        if (needs.place)
            add_elastic_hessian_product(
                zone.cloth(c), parameters, zone.dt, part.start, x, z, scale,
                result.place_gradient.nodes.data() + part.first_node);
        const bool through_damping = needs.place && parameters.damping > 0.0;
        if (!needs.material && !through_damping) continue;
        result.cloth_gradient[static_cast<std::size_t>(c)] = add_elastic_backward(
            zone.cloth(c), parameters, zone.dt, part.start, x, start.data() + part.first_node, z, scale,
            result.start_gradient.data() + part.first_node);
    }
}

}  // namespace

LinearisedZone linearise(const Zone& zone, const ZonePoint& point) {
    const FreeCoordinates free(zone);
    Rows rows = collect_rows(zone, point, free);
    LinearisedZone result;
    result.inertia = MatrixX::Zero(free.size(), free.size());
    for (int i = 0; i < zone.dynamic_count; ++i) {
        result.bodies.push_back(zone.bodies[i].id);
        result.inertia.block<6, 6>(6 * i, 6 * i) = mass_matrix(zone.bodies[i]);
    }
    for (const ZoneCloth& part : zone.cloths) {
        const Cloth& cloth = zone.model->cloths[part.id];
        for (int k = 0; k < cloth.node_count(); ++k)
            if (free.row(part.first_node + k) >= 0) result.nodes.push_back(cloth.first_node + k);
    }
    const MatrixX cloth = cloth_matrix(zone, point, free);
    result.inertia.bottomRightCorner(cloth.rows(), cloth.cols()) = cloth;
    result.J = std::move(rows.J);
    result.stiffness = std::move(rows.stiffness);
    return result;
}

const ZoneAdjoint& zone_adjoint(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, AdjointMode mode, const GradientNeeds& needs,
    AdjointWorkspace& workspace) {
    const bool exact = mode == AdjointMode::exact;
    BlockSystem& system = workspace.system;
    ZoneDerivatives& derivatives = workspace.derivatives;
    ZoneAdjoint& result = workspace.result;
    std::vector<Vec6>& twist = workspace.twist;
    result.multiplier = upstream;
    for (int i = 0; i < zone.node_count(); ++i)
        if (zone.nodes[i].pinned) result.multiplier.nodes[i].setZero();
    std::vector<double> reactions;
    VectorX multipliers;
    if (exact) {
        system.set_pattern(base_pattern(zone));
        differentiate(zone, point, Curvature::full, derivatives, &system);
        if (!system.factorize()) {
            // Only where the forward stopped short of a minimum. Without negative curvature the answer stays finite.
            differentiate(zone, point, Curvature::full, derivatives, &system, kAllCut);
            system.factorize();
        }
        reactions = solve(zone, point, result.multiplier, [&](Coordinates& z) { system.solve_in_place(z); });
    } else {
        const FreeCoordinates free(zone);
        const Rows rows = collect_rows(zone, point, free);
        const MatrixX cloth = cloth_matrix(zone, point, free);
        const auto solve_by = [&](const auto& solve_kkt) {
            reactions = solve(zone, point, result.multiplier, [&](Coordinates& z) {
                KktSolution solution = solve_kkt(z);
                z = std::move(solution.z);
                multipliers = std::move(solution.multipliers);
            });
        };
        if (mode == AdjointMode::dense) {
            solve_by([&](const Coordinates& v) { return solve_dense(zone, free, cloth, rows, v); });
        } else {
            const InertiaFactor factor(zone, cloth);
            solve_by([&](const Coordinates& v) { return solve_qr(free, factor, rows, v); });
        }
    }

    result.place_gradient.assign_zero(zone.bodies.size(), zone.nodes.size());
    result.start_gradient.assign(zone.nodes.size(), Vec3::Zero());
    result.mass_gradient.assign(static_cast<std::size_t>(zone.dynamic_count), 0.0);
    result.node_mass_gradient.assign(zone.nodes.size(), 0.0);
    result.cloth_gradient.assign(zone.cloths.size(), ClothParameters{});
    twist.assign(zone.bodies.size(), Vec6::Zero());
    for (int i = 0; i < zone.dynamic_count; ++i) {
        twist[i] = result.multiplier.bodies[i];
        twist[i].head<3>() = left_jacobian(point.y.bodies[i].head<3>()) * result.multiplier.bodies[i].head<3>();
    }
    for (int i = 0; i < zone.dynamic_count && needs.place; ++i) {
        const Vec3 torque = exact ? derivatives.torque[i] : Vec3(Vec3::Zero());
        Vec6& gradient = result.place_gradient.bodies[i];
        gradient =
            -contact_share(zone.bodies[i], point.y.bodies[i], torque, upstream.bodies[i], result.multiplier.bodies[i]);
        // A turn of the base turns the torque too: d(torque) = (H - ½ [torque]x) phi with H symmetric.
        gradient.head<3>() -= 0.5 * torque.cross(twist[i].head<3>());
    }
    if (needs.mass && !zone.hard) {
        if (!exact) differentiate(zone, point, Curvature::none, derivatives, nullptr);
        add_body_stiffness(zone, derivatives.body_contacts, twist, result);
    }
    if (needs.place || needs.mass)
        add_contacts(zone, point, exact ? nullptr : &multipliers, needs, twist, reactions, result);
    if (!zone.cloths.empty() && zone.elastic) add_elasticity(zone, point, needs, result);
    return result;
}

}  // namespace diffsim
