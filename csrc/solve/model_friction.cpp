#include <algorithm>
#include <cmath>

#include "solve/model_direction.hpp"
#include "zone/contacts.hpp"
#include "zone/sides_of.hpp"
#include "zone/zone_accuracy.hpp"

/// What friction adds to the models of a zone.
namespace diffsim {
namespace {

constexpr int kHoldingRounds = 2;
constexpr double kHoldingAccuracy = 1e-6;  // of what may be left of the balance: to which each is solved

}  // namespace

/// What sticks is held by the springs of one model, and by the next one's from there on.
void ModelDirection::advance_multipliers() {
    for (FrictionState& state : m_friction) state.multiplier = state.share;
    for (Kept& kept : m_kept) kept.friction.multiplier = kept.friction.share;
}

/// What its spring is stretched by, from the multiplier on.
Vec2 ModelDirection::Stopped::stretch(const FrictionRow& slip) const {
    return slip.slip + reach * Vec2(slip.tangents[0].dot(multiplier), slip.tangents[1].dot(multiplier));
}

Vec2 ModelDirection::Stopped::pull(const FrictionRow& slip) const {
    const Vec2 w = stretch(slip);
    return bound / std::max(w.norm(), reach) * w;
}

void ModelDirection::stop_bounds(double share) {
    recall_forces();
    std::vector<Stopped> stopped;
    for (const ActiveContact& active : m_point.active) {
        const ZoneContact& contact = m_zone.contacts[active.index];
        const double bound = contact.law.friction * contact_force(active.geometry, contact.law);
        if (!(bound > 0.0)) continue;
        const FrictionState& state = m_friction[static_cast<std::size_t>(active.index)];
        const double compression = contact.law.range.rest - active.geometry.distance;
        stopped.push_back({contact.contact, bound, share * contact.law.friction * compression, state.share});
    }
    std::sort(stopped.begin(), stopped.end(), [](const auto& a, const auto& b) {
        return comes_before(a.contact, b.contact);
    });
    m_stopped = std::move(stopped);
}

const ModelDirection::Stopped* ModelDirection::find_stopped(const Contact& contact) const {
    const auto found = std::lower_bound(
        m_stopped.begin(), m_stopped.end(), contact,
        [](const Stopped& stopped, const Contact& c) { return comes_before(stopped.contact, c); });
    return found == m_stopped.end() || comes_before(contact, found->contact) ? nullptr : &*found;
}

/// Of contacts that have opened since, too: else they would be no forces of an energy.
void ModelDirection::add_stopped_forces(Coordinates& gradient) const {
    const Placement at{m_point.y, m_point.poses, m_point.nodes};
    for (const ZoneContact& contact : m_zone.contacts) {
        const Stopped* stopped = find_stopped(contact.contact);
        if (stopped == nullptr) continue;
        const ContactGeometry geometry = contact_geometry(m_zone, contact, m_point.poses, m_point.nodes);
        if (geometry.sine_sq == 0.0) continue;
        const ContactRow row = make_row(m_zone, contact, geometry, at, at.y, 0.0);
        const FrictionRow slip = make_friction_row(m_zone, contact, geometry, at, at.y);
        add_friction(slip, row, stopped->pull(slip), gradient);
    }
}

void ModelDirection::add_friction_forces(Coordinates& gradient) {
    recall_forces();
    if (!m_stopped.empty()) return add_stopped_forces(gradient);
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

ContactFriction ModelDirection::friction_of(const ActiveContact& active) {
    recall_forces();
    const ZoneContact& contact = m_zone.contacts[active.index];
    ContactFriction found = m_friction[static_cast<std::size_t>(active.index)];
    if (!found.slips || active.geometry.sine_sq == 0.0) return found;
    const Placement at{m_point.y, m_point.poses, m_point.nodes};
    found.slips = make_friction_row(m_zone, contact, active.geometry, at, at.y).slip.norm() > kRestingSlip;
    return found;
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

/// At rest the contacts' own forces are known from where all is, and what friction has to add is a convex problem: of
/// friction with bounds that stay against inertia alone, which is so soft beside the springs of what sticks that a
/// round of multipliers leaves next to nothing. In a model the springs of the contacts work against it.
void ModelDirection::hold(const Coordinates& gradient, double tolerance) {
    make_resting_model(gradient);
    std::vector<double> forces;
    for (const ContactRow& row : m_model.rows) forces.push_back(row.force);
    BalanceGoal goal;
    goal.tolerance = kHoldingAccuracy * tolerance;
    goal.bounds_stay = true;
    Coordinates p;
    for (int round = 0; round < kHoldingRounds; ++round) {
        p.assign_zero(static_cast<std::size_t>(m_zone.dynamic_count), m_zone.nodes.size());
        if (balance(m_model, m_zone, goal, m_system, m_balance, p).status != ModelSolution::Status::solved) return;
        for (FrictionRow& slip : m_model.friction) slip.multiplier = slip.share;
    }
    Coordinates left = gradient;
    for (FrictionRow& slip : m_model.friction) {
        add_friction(slip, m_model.rows[slip.normal], slip.bound * slip.share, left);
        slip.slips = slip.slips && slip.slip.norm() > kRestingSlip;
    }
    if (largest_scaled(m_zone, left) > tolerance) return;
    for (std::size_t r = 0; r < forces.size(); ++r) m_model.rows[r].force = forces[r];
    keep_forces();
}

/// Its rows have the contacts' forces, and no stiffness.
void ModelDirection::make_resting_model(const Coordinates& gradient) {
    m_weight.resize(static_cast<std::size_t>(m_zone.dynamic_count) + m_zone.nodes.size(), 0.0);
    m_gradient = &gradient;
    m_with_curvature = false;
    recall_forces();
    m_near.clear();
    for (const ActiveContact& active : m_point.active) add_near(active.index, active.geometry);
    make_model();
    m_model.gradient = gradient;  // with the contacts' forces in it
    for (ContactRow& row : m_model.rows) {
        row.force = row.stiffness * row.missing;
        row.stiffness = 0.0;
    }
    for (FrictionRow& slip : m_model.friction) {
        const ContactRow& row = m_model.rows[slip.normal];
        slip.bound = slip.coefficient * row.force;
        slip.reach = kHoldingShare * slip.coefficient * row.missing;
    }
}

double ModelDirection::friction_work(double step) const {
    const bool stopped = !m_stopped.empty();
    const auto energy = [](const Vec2& slip, double reach) {
        const double size = slip.norm();
        return size > reach ? size - 0.5 * reach : 0.5 * size * size / reach;
    };
    std::vector<Vec2> moved;
    slips_times(m_model.friction, m_model.rows, m_way, moved);
    double sum = 0.0;
    for (std::size_t f = 0; f < m_model.friction.size(); ++f) {
        const FrictionRow& slip = m_model.friction[f];
        const double bound = stopped ? slip.bound : slip.coefficient * m_model.rows[slip.normal].force;
        if (!(bound > 0.0)) continue;
        const Vec2 begin = stopped ? Vec2(slip.slip + slip.reach * slip.multiplier) : slip.slip;
        sum += bound * (energy(begin + step * moved[f], slip.reach) - energy(begin, slip.reach));
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
    if (!m_stopped.empty()) {
        const Stopped* stopped = find_stopped(contact.contact);
        slip.bound = stopped != nullptr ? stopped->bound : 0.0;
        slip.reach = stopped != nullptr ? stopped->reach : contact.law.range.rest;
        slip.multiplier.setZero();
        if (stopped != nullptr) slip.multiplier = (stopped->stretch(slip) - slip.slip) / stopped->reach;
    }
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
