#include <algorithm>
#include <cmath>

#include "solve/model_direction.hpp"
#include "zone/sides_of.hpp"

/// What friction adds to the models of a zone.
namespace diffsim {

/// What sticks is held by the springs of one model, and by the next one's from there on.
void ModelDirection::advance_multipliers() {
    for (FrictionState& state : m_friction) state.multiplier = state.share;
    for (Kept& kept : m_kept) kept.friction.multiplier = kept.friction.share;
}

void ModelDirection::add_friction_forces(Coordinates& gradient) {
    recall_forces();
    const Placement at{m_point.y, m_point.poses, m_point.nodes};
    for (const ActiveContact& active : m_point.active) {
        const FrictionState& state = m_friction[static_cast<std::size_t>(active.index)];
        if (!state.is_known) continue;
        const ZoneContact& contact = m_zone.contacts[active.index];
        const ContactGeometry& geometry = active.geometry;
        const double force = contact_force(geometry, contact.law);
        if (!(contact.law.friction * force > 0.0)) continue;
        const ContactRow row = make_row(m_zone, contact, geometry, at, at.y, 0.0);
        FrictionRow slip = make_friction_row(m_zone, contact, geometry, at, at.y);
        slip.set_state(state);
        add_friction(slip, row, contact.law.friction * force * slip.share, gradient);
    }
}

double ModelDirection::largest_slip() const {
    const Placement at{m_point.y, m_point.poses, m_point.nodes};
    double largest = 0.0;
    for (const ActiveContact& active : m_point.active) {
        const ZoneContact& contact = m_zone.contacts[active.index];
        if (!(contact.law.friction > 0.0) || active.geometry.sine_sq == 0.0) continue;
        double mass = 0.0;
        visit_movers(
            m_zone, contact,
            [&](int body) {
                if (m_zone.yields(body)) mass = std::max(mass, m_zone.bodies[body].mass);
            },
            [&](int node) {
                if (!m_zone.nodes[node].pinned) mass = std::max(mass, m_zone.nodes[node].mass);
            });
        const FrictionRow slip = make_friction_row(m_zone, contact, active.geometry, at, at.y);
        largest = std::max(largest, std::sqrt(mass) * slip.slip.norm());
    }
    return largest;
}

double ModelDirection::friction_work(double step) const {
    const auto energy = [](const Vec2& slip, double reach) {
        const double size = slip.norm();
        return size > reach ? size - 0.5 * reach : 0.5 * size * size / reach;
    };
    std::vector<Vec2> moved;
    slips_times(m_model.friction, m_model.rows, m_way, moved);
    double sum = 0.0;
    for (std::size_t f = 0; f < m_model.friction.size(); ++f) {
        const FrictionRow& slip = m_model.friction[f];
        const double bound = slip.coefficient * m_model.rows[slip.normal].force;
        if (!(bound > 0.0)) continue;
        sum += bound * (energy(slip.slip + step * moved[f], slip.reach) - energy(slip.slip, slip.reach));
    }
    return sum;
}

/// Of the last row.
void ModelDirection::add_friction_row(const NearContact& near, const ContactGeometry& geometry) {
    const ZoneContact& contact = m_zone.contacts[near.contact];
    if (!(contact.law.friction > 0.0)) return;
    FrictionRow slip = make_friction_row(m_zone, contact, geometry, m_at, m_point.y);
    slip.normal = m_model.rows.size() - 1;
    slip.set_state(m_friction[static_cast<std::size_t>(near.contact)]);
    m_model.friction.push_back(std::move(slip));
}

void ModelDirection::add_turns() {
    FrictionTerm term;
    for (std::size_t f = 0; f < m_model.friction.size(); ++f) {
        const FrictionRow& slip = m_model.friction[f];
        const NearContact& near = m_near[slip.normal];
        const double force = m_model.rows[slip.normal].force;
        if (!slip.is_known || !(force > 0.0)) continue;
        const FrictionState& state = m_friction[static_cast<std::size_t>(near.contact)];
        make_friction_term(m_zone, m_point, near.contact, near.geometry, force, {state.share, false}, term);
        const std::size_t changes = m_model.turns.forces.add(term, term.changes);
        m_model.turns.slips.push_back(
            {term.sides, term.side_count, f, changes, term.rows, term.slip - term.rows.transpose()});
    }
}

}  // namespace diffsim
