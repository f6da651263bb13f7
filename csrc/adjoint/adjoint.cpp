#include "adjoint/adjoint.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <utility>

#include "adjoint/friction_adjoint.hpp"
#include "adjoint/linearised_zone.hpp"
#include "math/rotation.hpp"
#include "zone/chart.hpp"
#include "zone/contact_term.hpp"
#include "zone/elasticity.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

/// Exact contacts: J z = 0 with reactions r, H z + Jᵀ r = v, by proximal steps r += stiffness * J z on the system that
/// gives way. Every step leaves about a compliance's part; they end when z no longer changes, since a small J z alone
/// does not mean that z is right. Returns the reactions, the last step's left out: the soft contacts carry it.
template <typename SolveInPlace>
std::vector<double> find_reactions(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, const SolveInPlace& solve_in_place,
    Coordinates& z) {
    constexpr int kMaxSteps = 30;
    constexpr double kTolerance = 1e-14;  // on the change of z, relative: rounding
    std::vector<ContactTerm> terms;
    for (const ActiveContact& active : point.active)
        terms.push_back(contact_term(zone, point, active, Curvature::none));
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

/// Overwrite the upstream gradient by z. Returns the reactions of contacts, if they are exact.
template <typename SolveInPlace>
std::vector<double> solve(
    const Zone& zone, const ZonePoint& point, Coordinates& z, const SolveInPlace& solve_in_place) {
    const Coordinates upstream = zone.exact_contact ? z : Coordinates();
    solve_in_place(z);
    return zone.exact_contact ? find_reactions(zone, point, upstream, solve_in_place, z) : std::vector<double>();
}

/// What the contacts of a body that yields take of the upstream gradient v, along its twist J dy at the end
/// of the step. With H = M + C + Jᵀ K J the matrix of  H z = v,  K of the contacts and C the curvature of
/// the chart under their torque:
///     K J z + Jᵀ⁻¹ (M + C) z = Jᵀ⁻¹ v.
/// Of exact contacts, whose reactions stand beside H z, they are part of it.
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
    const Zone& zone, const std::vector<PairSums>& contacts, const std::vector<Vec6>& twist, ZoneAdjoint& result) {
    for (const PairSums& c : contacts) {
        double along = 0.0;
        for (const auto& [body, part] : {std::pair<int, Vec6>(c.a, c.gradient.head<6>()), {c.b, c.gradient.tail<6>()}})
            if (zone.yields(body)) along += part.dot(twist[body]);
        if (zone.yields(c.a)) result.mass_gradient[c.a] -= along * c.stiffness.log_gradient_a;
        if (zone.yields(c.b)) result.mass_gradient[c.b] -= along * c.stiffness.log_gradient_b;
    }
}

/// What contacts add to the gradients: to those of places that the linear system has no rows for, `twist` times their
/// second derivatives and the reactions of exact ones; with cloth, to those of masses, through their stiffness.
/// `multipliers`: stiffness times what opens each contact along `twist`, where contacts are rows of constant direction;
/// null where they have curvature.
void add_contacts(
    const Zone& zone, const ZonePoint& point, const VectorX* multipliers, const GradientNeeds& needs,
    const std::vector<Vec6>& twist, const std::vector<double>& reactions, ZoneAdjoint& result) {
    for (std::size_t k = 0; k < point.active.size(); ++k) {
        const ActiveContact& active = point.active[k];
        const ZoneContact& contact = zone.contacts[active.index];
        const bool with_place = needs.place && !is_of_yielding_bodies(zone, contact);
        // An exact contact's stiffness is only how its multiplier was found.
        const bool through_stiffness = needs.mass && !zone.exact_contact && contact.has_cloth();
        if (!with_place && !through_stiffness) continue;
        const ContactTerm term =
            contact_term(zone, point, active, with_place && multipliers == nullptr ? Curvature::full : Curvature::none);
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
            if (zone.exact_contact) gradient += reactions[k] * term.row;
            term.for_each(
                [&](int body, int offset) {
                    if (!zone.yields(body)) result.pose_gradient.bodies[body] -= gradient.segment<6>(offset);
                },
                [&](int node, int offset) { result.pose_gradient.nodes[node] -= gradient.segment<3>(offset); });
        }
        if (!through_stiffness) continue;
        const double along = term.gradient.dot(motion);
        for (std::size_t s = 0; s < static_cast<std::size_t>(term.side_count); ++s) {
            const double part =
                -along * (s == 0 ? contact.law.stiffness.log_gradient_a : contact.law.stiffness.log_gradient_b);
            if (zone.yields(term.sides[s].body)) result.mass_gradient[term.sides[s].body] += part;
            for (int node : term.sides[s].nodes)
                if (node >= 0) result.node_mass_gradient[node] += part;
        }
    }
}

/// The bodies that yield: their part of the gradient of poses, and how they move along z at the end of the step.
void add_bodies(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, const std::vector<Vec3>* torques,
    const GradientNeeds& needs, std::vector<Vec6>& twist, ZoneAdjoint& result) {
    twist.assign(zone.bodies.size(), Vec6::Zero());
    for (int i = 0; i < zone.dynamic_count; ++i) {
        twist[i] = result.multiplier.bodies[i];
        twist[i].head<3>() = left_jacobian(point.y.bodies[i].head<3>()) * result.multiplier.bodies[i].head<3>();
    }
    for (int i = 0; i < zone.dynamic_count && needs.place; ++i) {
        const Vec3 torque = torques != nullptr ? (*torques)[i] : Vec3(Vec3::Zero());
        Vec6& gradient = result.pose_gradient.bodies[i];
        gradient =
            -contact_share(zone.bodies[i], point.y.bodies[i], torque, upstream.bodies[i], result.multiplier.bodies[i]);
        // A turn of the base turns the torque too: d(torque) = (H - ½ [torque]x) phi with H symmetric.
        gradient.head<3>() -= 0.5 * torque.cross(twist[i].head<3>());
    }
}

/// What a solve for z finds beside it.
struct Multipliers {
    std::vector<double> reactions;  ///< of exact contacts
    VectorX rows;                   ///< stiffness times what opens each contact along z, where contacts are rows
};

/// Overwrite the multiplier of the workspace's result, the upstream gradient, by z.
Multipliers solve_exactly(
    const Zone& zone, const ZonePoint& point, FrictionAdjoint& friction, AdjointWorkspace& workspace) {
    BlockSystem& system = workspace.system;
    system.set_pattern(base_pattern(zone));
    differentiate(zone, point, Curvature::full, workspace.derivatives, &system);
    if (!friction.empty()) {
        if (friction.solve(system, workspace.result.multiplier)) return {};
        differentiate(zone, point, Curvature::full, workspace.derivatives, &system, kAllCut);
        friction.solve(system, workspace.result.multiplier);
        return {};
    }
    if (!system.factorize()) {
        // Only where the forward stopped short of a minimum. Without negative curvature the answer stays finite.
        differentiate(zone, point, Curvature::full, workspace.derivatives, &system, kAllCut);
        system.factorize();
    }
    const auto in_place = [&](Coordinates& z) { system.solve_in_place(z); };
    return {solve(zone, point, workspace.result.multiplier, in_place), {}};
}

/// The same with contacts as rows.
Multipliers solve_linearised(const Zone& zone, const ZonePoint& point, AdjointMode mode, ZoneAdjoint& result) {
    const LinearisedSolver solver(zone, point, mode);
    Multipliers multipliers;
    multipliers.reactions = solve(zone, point, result.multiplier, [&](Coordinates& z) {
        KktSolution solution = solver.solve(z);
        z = std::move(solution.z);
        multipliers.rows = std::move(solution.multipliers);
    });
    return multipliers;
}

void start_result(const Zone& zone, const Coordinates& upstream, ZoneAdjoint& result) {
    result.multiplier = upstream;
    for (int i = 0; i < zone.node_count(); ++i)
        if (zone.nodes[i].pinned) result.multiplier.nodes[i].setZero();
    result.pose_gradient.assign_zero(zone.bodies.size(), zone.nodes.size());
    result.drive_gradient.assign_zero(zone.bodies.size(), zone.nodes.size());
    result.friction_gradient.clear();
    result.start_gradient.assign(zone.nodes.size(), Vec3::Zero());
    result.first_stage_gradient.assign(zone.nodes.size(), Vec3::Zero());
    result.mass_gradient.assign(static_cast<std::size_t>(zone.dynamic_count), 0.0);
    result.node_mass_gradient.assign(zone.nodes.size(), 0.0);
    result.cloth_gradient.assign(zone.cloths.size(), ClothParameters{});
}

}  // namespace

const ZoneAdjoint& zone_adjoint(
    const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>& friction, const Coordinates& upstream,
    AdjointMode mode, const GradientNeeds& needs, AdjointWorkspace& workspace) {
    const bool exact = mode == AdjointMode::exact;
    ZoneDerivatives& derivatives = workspace.derivatives;
    ZoneAdjoint& result = workspace.result;
    std::vector<Vec6>& twist = workspace.twist;
    start_result(zone, upstream, result);
    FrictionAdjoint friction_adjoint(zone, point, friction);
    const Multipliers multipliers =
        exact ? solve_exactly(zone, point, friction_adjoint, workspace) : solve_linearised(zone, point, mode, result);
    const auto add_bodies_for = [&](const Coordinates& v) {
        add_bodies(zone, point, v, exact ? &derivatives.torque : nullptr, needs, twist, result);
    };
    if (friction_adjoint.empty()) {
        add_bodies_for(upstream);
    } else {
        add_bodies_for(friction_adjoint.left_by_friction(upstream, result.multiplier));
        friction_adjoint.add_gradients(result.multiplier, result);
    }
    if (needs.mass && !zone.exact_contact) {
        if (!exact) differentiate(zone, point, Curvature::none, derivatives, nullptr);
        add_body_stiffness(zone, derivatives.pair_sums, twist, result);
    }
    if (needs.place || needs.mass)
        add_contacts(zone, point, exact ? nullptr : &multipliers.rows, needs, twist, multipliers.reactions, result);
    if (!zone.cloths.empty() && zone.elastic)
        add_elastic_backward(
            zone, point, result.multiplier.nodes, needs.place, needs.material,
            {result.pose_gradient.nodes, result.start_gradient, result.drive_gradient.nodes,
             result.first_stage_gradient, result.cloth_gradient});
    return result;
}

}  // namespace diffsim
