#include "solve/model_direction.hpp"

#include <algorithm>
#include <array>
#include <cmath>

#include "zone/contacts.hpp"
#include "zone/elasticity.hpp"
#include "zone/motion_bounds.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

constexpr double kMaxTurn = 0.5;                              // [rad] of a fast body in one way
constexpr double kCrawling = 0.2;                             // of a Newton step: rows are not followed so
constexpr std::array<double, 3> kStages = {1e-2, 1e-1, 1.0};  // of the rows' stiffness

}  // namespace

ModelDirection::ModelDirection(const Zone& zone, ZonePath& path, ZonePoint& point, BlockSystem& system)
    : m_zone(zone), m_path(path), m_point(point), m_system(system) {}

// --- forces, across lists of contacts --------------------------------------------------------------------------------

void ModelDirection::recall_forces() {
    if (m_list == m_path.list_number()) return;
    m_list = m_path.list_number();
    m_forces.assign(m_zone.contacts.size(), 0.0);
    m_friction.assign(m_zone.contacts.with_friction ? m_zone.contacts.size() : 0, {});
    if (m_kept.empty()) return;
    for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
        const Contact& contact = m_zone.contacts[k].contact;
        const auto found = std::lower_bound(
            m_kept.begin(), m_kept.end(), contact,
            [](const Kept& kept, const Contact& c) { return comes_before(kept.contact, c); });
        if (found == m_kept.end() || comes_before(contact, found->contact)) continue;
        m_forces[k] = found->force;
        if (!m_friction.empty()) m_friction[k] = found->friction;
    }
}

void ModelDirection::start_from(const ZonePoint& point) {
    m_kept.clear();
    for (const ActiveContact& active : point.active) {
        const ZoneContact& contact = m_zone.contacts[active.index];
        const double force = contact_force(active.geometry, contact.law);
        if (force > 0.0) m_kept.push_back({contact.contact, force, {}});
    }
    sort_kept();
    m_list = -1;
}

void ModelDirection::recall(Memory memory) {
    m_kept = std::move(memory);
    m_list = -1;
    forget_damping();
}

void ModelDirection::keep_forces() {
    m_kept.clear();
    std::fill(m_forces.begin(), m_forces.end(), 0.0);
    std::fill(m_friction.begin(), m_friction.end(), FrictionState());
    for (const FrictionRow& slip : m_model.friction) {
        const ContactRow& row = m_model.rows[slip.normal];
        if (row.force > 0.0) m_friction[row.contact] = slip.state();
    }
    for (const ContactRow& row : m_model.rows) {
        if (!(row.force > 0.0)) continue;
        m_forces[row.contact] = row.force;
        m_kept.push_back(
            {m_zone.contacts[row.contact].contact, row.force,
             m_friction.empty() ? FrictionState() : m_friction[row.contact]});
    }
    sort_kept();
}

void ModelDirection::sort_kept() {
    std::sort(
        m_kept.begin(), m_kept.end(), [](const Kept& a, const Kept& b) { return comes_before(a.contact, b.contact); });
}

// --- the model -------------------------------------------------------------------------------------------------------

/// Near are contacts that push, did in the last model, or may come to on the way to where nothing holds the bodies.
void ModelDirection::list_near() {
    m_near.clear();
    Coordinates free = m_point.y;
    m_path.set_to_targets(free);
    MotionBounds motion(m_zone, m_point.y, free);
    auto active = m_point.active.begin();
    for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
        const ZoneContact& contact = m_zone.contacts[k];
        const int index = static_cast<int>(k);
        while (active != m_point.active.end() && active->index < index) ++active;
        if (active != m_point.active.end() && active->index == index) {
            add_near(index, active->geometry);
            continue;
        }
        if (m_forces[k] == 0.0 && m_point.distances[k] - motion.approach(contact) > contact.law.range.rest) continue;
        add_near(index);
    }
}

void ModelDirection::add_near(int index) {
    const ZoneContact& contact = m_zone.contacts[index];
    add_near(index, contact_geometry(m_zone, contact, m_point.poses, m_point.nodes));
}

/// A compressed contact has its secant stiffness, so that the row's force is the contact's where they are now.
void ModelDirection::add_near(int index, const ContactGeometry& geometry) {
    if (geometry.sine_sq == 0.0) return;  // parallel edges push nothing
    const ZoneContact& contact = m_zone.contacts[index];
    double stiffness = contact.law.stiffness.value, wanted = contact.law.range.rest;
    const double compression = contact.law.range.rest - geometry.distance;
    if (compression > 0.0) {
        const PotentialValue push = normal_force(contact.law, geometry.distance);
        stiffness = push.force / compression;
        if (m_goal.is_settled) {
            stiffness = push.stiffness;
            wanted = geometry.distance + push.force / push.stiffness;
        }
    }
    m_near.push_back({index, geometry, edge_mollifier(geometry.sine_sq).value * stiffness, wanted});
}

void ModelDirection::sort_near() {
    std::sort(m_near.begin(), m_near.end(), [](const auto& a, const auto& b) { return a.contact < b.contact; });
}

void ModelDirection::make_model() {
    const bool with_nodes = !m_zone.nodes.empty();
    m_model.smooth.set_pattern(m_system.pattern());
    if (with_nodes) {
        std::vector<int> contacts;
        for (const NearContact& near : m_near) contacts.push_back(near.contact);
        ensure_pattern(m_zone, contacts, m_model.smooth);
        m_system.set_pattern(m_model.smooth.pattern());
    }
    m_pushing.clear();
    if (m_with_curvature) {
        for (const NearContact& near : m_near) {
            const double force = m_forces[near.contact];
            if (force > 0.0) m_pushing.push_back({near.contact, &near.geometry, force});
        }
    }
    const CutShare cut = with_nodes ? m_cut.share() : kNothingCut;
    differentiate_smooth(m_zone, m_point, m_pushing, cut, m_smooth, m_model.smooth);
    for (int i = 0; i < m_zone.dynamic_count; ++i) {
        const double weight = m_weight[static_cast<std::size_t>(i)];
        if (weight == 0.0) continue;
        m_model.smooth.diagonal(i).topLeftCorner<3, 3>() += weight * m_zone.bodies[i].inertia;
        m_model.smooth.diagonal(i).diagonal().tail<3>().array() += weight * m_zone.bodies[i].mass;
    }
    for (int i = 0; i < m_zone.node_count(); ++i) {
        const double weight = m_weight[static_cast<std::size_t>(m_zone.dynamic_count + i)];
        if (weight != 0.0 && !m_zone.nodes[i].pinned)
            m_model.smooth.node_diagonal(i).diagonal().array() += weight * m_zone.nodes[i].mass;
    }

    // The model has the energy's gradient: that of the rows which push now is in `gradient` already.
    m_model.gradient = *m_gradient;
    m_model.rows.clear();
    m_model.friction.clear();
    m_model.turns.clear();
    m_at.y = m_point.y;
    m_at.poses = m_point.poses;
    m_at.nodes = m_point.nodes;
    for (const NearContact& near : m_near) make_start_row(near);
    if (m_goal.turns) add_turns();
    if (!with_nodes || !m_zone.elastic) return;
    std::vector<Vec3> driven(m_zone.nodes.size(), Vec3::Zero());
    bool any = false;
    for (int i = 0; i < m_zone.node_count(); ++i) {
        if (!m_zone.nodes[i].pinned) continue;
        driven[i] = m_zone.nodes[i].target - m_point.y.nodes[i];
        any = any || !driven[i].isZero(0.0);
    }
    if (!any) return;
    add_elastic_product(m_zone, m_point, driven, m_model.gradient.nodes);
    for (int i = 0; i < m_zone.node_count(); ++i)
        if (m_zone.nodes[i].pinned) m_model.gradient.nodes[i].setZero();
}

void ModelDirection::make_start_row(const NearContact& near) {
    const ZoneContact& contact = m_zone.contacts[near.contact];
    ContactRow row = make_row(m_zone, contact, near.geometry, m_at, m_point.y, near.wanted);
    row.contact = near.contact;
    row.range = contact.law.range.rest - contact.law.range.floor;
    row.stiffness = near.stiffness;
    row.force = m_forces[near.contact];
    const double compression = near.wanted - near.geometry.distance;
    if (compression > 0.0) diffsim::add_row(row, row.stiffness * compression, m_model.gradient);
    m_model.rows.push_back(std::move(row));
    add_friction_row(near, near.geometry);
}

/// Cold, Newton's method crawls from one set of pushing rows to the next: from soft rows to stiff ones it
/// gets there in a few steps each.
bool ModelDirection::solve(Coordinates& p, int& newton_steps) {
    if (!m_model.friction.empty()) {
        const ModelSolution balanced = balance(m_model, m_zone, m_goal, m_system, m_balance, p);
        newton_steps += balanced.newton_steps;
        m_right_guess = balanced.newton_steps == 1;
        return balanced.status == ModelSolution::Status::solved ||
               (m_goal.may_crawl && balanced.status == ModelSolution::Status::crawling);
    }
    const Coordinates start = p;
    ModelSolution solution = minimise(m_model, 1.0, kCrawling, m_system, m_work, p);
    newton_steps += solution.newton_steps;
    m_right_guess = solution.newton_steps == 1;
    if (solution.status != ModelSolution::Status::crawling) return solution.status == ModelSolution::Status::solved;
    p = start;
    for (double share : kStages) {
        solution = minimise(m_model, share, 0.0, m_system, m_work, p);
        newton_steps += solution.newton_steps;
        if (solution.status != ModelSolution::Status::solved) return false;
    }
    return true;
}

/// Contacts that the way may violate and that have no row yet get one. False if there are none.
bool ModelDirection::add_missed(const Coordinates& y_end) {
    MotionBounds motion(m_zone, m_point.y, y_end);
    std::size_t near = 0;
    const std::size_t known = m_near.size();
    for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
        while (near < known && m_near[near].contact < static_cast<int>(k)) ++near;
        if (near < known && m_near[near].contact == static_cast<int>(k)) continue;
        const ZoneContact& contact = m_zone.contacts[k];
        if (m_point.distances[k] - motion.approach(contact) <= contact.law.range.rest) add_near(static_cast<int>(k));
    }
    if (m_near.size() == known) return false;
    sort_near();
    return true;
}

/// Fast bodies that meet would whirl around each other, where rows mean nothing: heavier, they turn
/// less. True if some got heavier.
bool ModelDirection::turns_too_far(const Coordinates& p) {
    bool too_far = false;
    for (std::size_t i = 0; i < p.bodies.size(); ++i) {
        const double turn = p.bodies[i].head<3>().norm();
        if (turn <= 1.1 * kMaxTurn || !m_path.is_fast(static_cast<int>(i))) continue;
        m_weight[i] = (1.0 + m_weight[i]) * turn / kMaxTurn - 1.0;
        too_far = true;
    }
    return too_far;
}

void ModelDirection::set_end(const Coordinates& p, Coordinates& y_end) const {
    y_end = m_point.y;
    for (std::size_t i = 0; i < y_end.bodies.size(); ++i) {
        if (static_cast<int>(i) < m_zone.dynamic_count)
            y_end.bodies[i] += p.bodies[i];
        else
            y_end.bodies[i] = m_zone.bodies[i].target;
    }
    for (std::size_t i = 0; i < y_end.nodes.size(); ++i) {
        if (m_zone.nodes[i].pinned)
            y_end.nodes[i] = m_zone.nodes[i].target;
        else
            y_end.nodes[i] += p.nodes[i];
    }
}

}  // namespace diffsim
