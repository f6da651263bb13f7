#include "adjoint/friction_adjoint.hpp"

#include <cmath>

#include "zone/gmres.hpp"

namespace diffsim {
namespace {

constexpr int kMultiplierRounds = 3;      // of multipliers: each leaves about 1 / kStickStiffening of the slip
constexpr double kStickStiffening = 1e3;  // of sticking contacts, times their own
constexpr double kLinearTolerance = 1e-13;
constexpr int kMaxLinear = 60;

}  // namespace

FrictionAdjoint::FrictionAdjoint(const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>& friction)
    : m_zone(zone) {
    for (std::size_t k = 0; k < friction.size(); ++k) {
        const ActiveContact& active = point.active[k];
        if (!(zone.contacts.law(static_cast<std::size_t>(active.index)).friction > 0.0)) continue;
        if (active.geometry.sine_sq == 0.0) continue;  // parallel edges push nothing
        Term& term = m_terms.emplace_back();
        static_cast<FrictionTerm&>(term) = friction_term(zone, point, active.index, active.geometry, friction[k]);
        term.contact = active.index;
    }
}

void FrictionAdjoint::add_symmetric(const Term& term, const SmallMatrix& matrix, BlockSystem& system) const {
    const int block = m_zone.contacts[static_cast<std::size_t>(term.contact)].block;
    term.for_each(
        [&](int body, int offset) {
            if (!m_zone.yields(body)) return;
            term.for_each(
                [&](int other, int column) {
                    if (!m_zone.yields(other) || other < body) return;
                    (other == body ? system.diagonal(body) : system.off_diagonal(block)) +=
                        matrix.block<6, 6>(offset, column);
                },
                [&](int node, int column) {
                    if (!m_zone.nodes[node].pinned)
                        system.mixed_pair(system.find_mixed_pair(body, node)) += matrix.block<6, 3>(offset, column);
                });
        },
        [&](int node, int offset) {
            term.for_each(
                [](int, int) {},
                [&](int other, int column) {
                    if (other >= node) add_node_block(m_zone, node, other, matrix.block<3, 3>(offset, column), system);
                });
        });
}

bool FrictionAdjoint::solve(BlockSystem& system, Coordinates& z) {
    bool sticks = false;
    for (Term& term : m_terms) {
        const double stiffness = term.sticks ? kStickStiffening * term.stiffness : 0.0;
        const Eigen::Matrix2d along =
            term.sticks ? Eigen::Matrix2d(stiffness * Eigen::Matrix2d::Identity()) : term.symmetric;
        const SmallMatrix symmetric = term.rows * along * term.rows.transpose();
        add_symmetric(term, symmetric, system);
        term.beyond = term.changes - symmetric;
        if (term.sticks) term.beyond += stiffness * term.rows * term.slip;
        sticks = sticks || term.sticks;
    }
    if (!system.factorize()) return false;
    const auto apply = [&](const Coordinates& x) {
        Coordinates result;
        result.assign_zero(x.bodies.size(), x.nodes.size());
        for (const Term& term : m_terms)
            scatter(
                m_zone, term, 1.0, SmallVector(term.beyond.transpose().lazyProduct(gather(m_zone, term, x))), result);
        system.solve_in_place(result);
        add(1.0, x, result);
        return result;
    };
    const Coordinates upstream = z;
    for (int round = 0; round < (sticks ? kMultiplierRounds : 1); ++round) {
        z = upstream;
        for (const Term& term : m_terms)
            if (term.sticks) scatter(m_zone, term, -1.0, SmallVector(term.slip.transpose() * term.multiplier), z);
        system.solve_in_place(z);
        gmres(m_zone, apply, kLinearTolerance, kMaxLinear, z);
        for (Term& term : m_terms)
            if (term.sticks)
                term.multiplier +=
                    kStickStiffening * term.stiffness * (term.rows.transpose() * gather(m_zone, term, z));
    }
    return true;
}

Coordinates FrictionAdjoint::left_by_friction(const Coordinates& upstream, const Coordinates& z) const {
    Coordinates left = upstream;
    for (const Term& term : m_terms) {
        SmallVector taken = term.changes.transpose() * gather(m_zone, term, z);
        if (term.sticks) taken += term.slip.transpose() * term.multiplier;
        scatter(m_zone, term, -1.0, taken, left);
    }
    return left;
}

void FrictionAdjoint::add_gradients(const Coordinates& z, ZoneAdjoint& result) const {
    for (const Term& term : m_terms) {
        const SmallVector along = gather(m_zone, term, z);
        SmallVector place = term.force_of_place.transpose() * along, motion = term.force_of_motion.transpose() * along;
        if (term.sticks) {
            place += term.slip_of_place.transpose() * term.multiplier;
            motion += term.slip_of_motion.transpose() * term.multiplier;
        }
        term.for_each(
            [&](int body, int offset) {
                result.pose_gradient.bodies[body] -= place.segment<6>(offset);
                if (!m_zone.yields(body)) result.drive_gradient.bodies[body] -= motion.segment<6>(offset);
            },
            [&](int node, int offset) {
                result.pose_gradient.nodes[node] -= place.segment<3>(offset);
                if (m_zone.nodes[node].pinned) result.drive_gradient.nodes[node] -= motion.segment<3>(offset);
            });
        if (term.sticks) continue;
        // The force is in proportion to the contact's stiffness and to μ, the geometric mean of two coefficients.
        const double part = -term.force.dot(along);
        const ZoneContact& contact = m_zone.contacts[static_cast<std::size_t>(term.contact)];
        const ContactStiffness& stiffness = contact.law.stiffness;
        for (int s = 0; s < term.side_count; ++s) {
            const ContactTerm::Side& side = term.sides[static_cast<std::size_t>(s)];
            const double of_mass = part * (s == 0 ? stiffness.log_gradient_a : stiffness.log_gradient_b);
            if (m_zone.yields(side.body)) result.mass_gradient[side.body] += of_mass;
            for (int node : side.nodes)
                if (node >= 0) result.node_mass_gradient[node] += of_mass;
        }
        for (int object : {contact.contact.object_a, contact.contact.object_b}) {
            const std::size_t index =
                object == kGround ? m_zone.friction->size() - 1 : static_cast<std::size_t>(object);
            result.friction_gradient.push_back({static_cast<int>(index), 0.5 * part / (*m_zone.friction)[index]});
        }
    }
}

}  // namespace diffsim
