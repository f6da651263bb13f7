#include "adjoint/friction_adjoint.hpp"

#include <algorithm>
#include <cmath>

#include "zone/gmres.hpp"

namespace diffsim {
namespace {

constexpr double kSpring = 10.0;           // of sticking contacts, times their own: much stiffer ones cost digits
constexpr double kGive = 0.01;             // of the springs' inverse: what slips give for their multipliers
constexpr int kRounds = 3;                 // each leaves about kGive / kSpring of what slips give
constexpr double kLinearTolerance = 1e-9;  // of a round
constexpr int kMaxLinear = 60;
constexpr double kSame = 1e-9;  // of slips: what differs by less is the same

/// Of the same bodies or nodes.
bool of_the_same(const FrictionTerm& a, const FrictionTerm& b) {
    const auto same = [](const auto& x, const auto& y) { return x.body == y.body && x.nodes == y.nodes; };
    return a.side_count == b.side_count && std::equal(a.sides.begin(), a.sides.end(), b.sides.begin(), same);
}

template <class Matrix>
bool is_near(const Matrix& a, const Matrix& b) {
    return a.rows() == b.rows() && a.cols() == b.cols() && (a - b).norm() <= kSame * b.norm();
}

}  // namespace

FrictionAdjoint::FrictionAdjoint(const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>& friction)
    : m_zone(zone) {
    m_terms.reserve(friction.size());
    for (std::size_t k = 0; k < friction.size(); ++k) {
        const ActiveContact& active = point.active[k];
        const ContactLaw law = zone.contacts.law(static_cast<std::size_t>(active.index));
        if (!(law.friction > 0.0)) continue;
        if (active.geometry.sine_sq == 0.0) continue;  // parallel edges push nothing
        Term& term = m_terms.emplace_back();
        const double force = contact_force(active.geometry, law);
        make_friction_term(zone, point, active.index, active.geometry, force, friction[k], term);
        term.contact = active.index;
    }
    find_held();
}

/// A corner on an edge touches it with each feature that ends there.
void FrictionAdjoint::find_held() {
    for (std::size_t k = 0; k < m_terms.size(); ++k) {
        Term& term = m_terms[k];
        if (!term.sticks) continue;
        Term* same = nullptr;
        for (std::size_t l = k; l-- > 0 && same == nullptr && of_the_same(m_terms[l], term);)
            if (m_terms[l].holds && is_near(m_terms[l].slip, term.slip) && is_near(m_terms[l].rows, term.rows))
                same = &m_terms[l];
        term.holds = same == nullptr;
        if (term.holds) m_held.push_back(k);
        (term.holds ? term : *same).stiffness_held += term.stiffness;
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

double FrictionAdjoint::dot(const Unknowns& x, const Unknowns& y) const {
    double sum = mass_dot(m_zone, x.z, y.z);
    for (std::size_t k = 0; k < m_held.size(); ++k)
        sum += x.multipliers[k].dot(y.multipliers[k]) / m_terms[m_held[k]].stiffness_held;
    return sum;
}

bool FrictionAdjoint::factorize(BlockSystem& system) {
    m_matrices.clear();
    for (Term& term : m_terms) {
        term.spring = term.holds ? kSpring * term.stiffness_held : 0.0;
        const Mat2 along = term.sticks ? Mat2(term.spring * Mat2::Identity()) : term.symmetric;
        const SmallMatrix symmetric = term.rows * along * term.rows.transpose();
        add_symmetric(term, symmetric, system);
        SmallMatrix beyond = term.changes - symmetric;
        if (term.holds) beyond += term.spring * term.rows * term.slip;
        m_matrices.add(term, beyond);
    }
    return system.factorize();
}

/// P⁻¹ A x, with A the system and P the upper triangle of blocks S, Cᵀ, -1/spring, S the system that is factorized.
FrictionAdjoint::Unknowns FrictionAdjoint::preconditioned(
    const BlockSystem& system, const Unknowns& x, double give) const {
    Unknowns result;
    result.z.assign_zero(x.z.bodies.size(), x.z.nodes.size());
    result.multipliers.resize(m_held.size());
    m_matrices.add_transposed_product(m_zone, 1.0, x.z, result.z);
    for (std::size_t k = 0; k < m_held.size(); ++k) {
        const Term& term = m_terms[m_held[k]];
        result.multipliers[k] =
            -term.spring * slips_along(term.rows, gather(m_zone, term, x.z)) - (1.0 - give) * x.multipliers[k];
        scatter(m_zone, term, -1.0, forces_of(term.slip, result.multipliers[k]), result.z);
    }
    system.solve_in_place(result.z);
    add(1.0, x, result);
    return result;
}

bool FrictionAdjoint::solve(BlockSystem& system, Coordinates& z) {
    if (!factorize(system)) return false;
    const auto apply = [&](const Unknowns& x) { return preconditioned(system, x, kGive); };
    const auto product = [&](const Unknowns& x, const Unknowns& y) { return dot(x, y); };
    Unknowns left{z, std::vector<Vec2>(m_held.size(), Vec2::Zero())};
    system.solve_in_place(left.z);
    const Unknowns begin = left;
    Unknowns x = left;
    scale(0.0, x);
    for (int round = 0;;) {
        gmres(apply, product, kLinearTolerance, kMaxLinear, left);
        add(1.0, left, x);
        if (++round == kRounds) break;
        left = begin;
        add(-1.0, preconditioned(system, x, 0.0), left);
    }
    z = x.z;
    for (std::size_t k = 0; k < m_held.size(); ++k) {
        Term& term = m_terms[m_held[k]];
        term.multiplier = x.multipliers[k] + term.spring * slips_along(term.rows, gather(m_zone, term, z));
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
