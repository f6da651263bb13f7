#include "solve/model_direction.hpp"

#include <algorithm>
#include <array>

#include "zone/contacts.hpp"
#include "zone/sides_of.hpp"

/// The way that a model leads: found, followed to where it ends, linearised there, and
/// shortened where something stops it.
namespace diffsim {
namespace {

constexpr int kMaxListings = 8;     // for a way that leads out of the list it was found with
constexpr int kMaxRounds = 2;       // of linearising again where a way ends
constexpr int kMaxFastRounds = 10;  // where bodies move so fast for their size that they could pass each other
constexpr int kMaxShortenings = 6;  // of the way of bodies that something still stops

}  // namespace

/// Rows are straight and bodies turn: make them again where the way ends. A pair that was hit on the way and whose
/// normal has turned over is on the other side of itself.
void ModelDirection::linearise_at(const Coordinates& y_end, const std::vector<Impact>& impacts) {
    const std::size_t known = m_near.size();
    std::size_t near_index = 0;
    for (const Impact& impact : impacts) {
        while (near_index < known && m_near[near_index].contact < impact.contact) ++near_index;
        if (near_index < known && m_near[near_index].contact == impact.contact) continue;
        add_near(impact.contact);
    }
    if (m_near.size() > known) {
        sort_near();
        if (!m_zone.nodes.empty()) {  // the matrix has blocks for the rows that it was made for
            make_model();
            if (m_aim != nullptr) set_aim(*m_aim);
        }
    }
    m_row_force.assign(m_zone.contacts.size(), 0.0);
    for (const ContactRow& row : m_model.rows) m_row_force[row.contact] = row.force;
    for (const FrictionRow& slip : m_model.friction)
        m_friction[static_cast<std::size_t>(m_model.rows[slip.normal].contact)] = slip.state();
    m_model.rows.clear();
    m_model.friction.clear();
    m_model.turns.clear();
    m_at.y = y_end;
    place(m_zone, y_end, m_at.poses, m_at.nodes);
    auto impact = impacts.begin();
    for (const NearContact& near : m_near) {
        const ZoneContact& contact = m_zone.contacts[near.contact];
        ContactGeometry geometry = contact_geometry(m_zone, contact, m_at.poses, m_at.nodes);
        while (impact != impacts.end() && impact->contact < near.contact) ++impact;
        const bool hit = impact != impacts.end() && impact->contact == near.contact;
        if (m_path.is_fast(contact)) {
            // Where the way ends such bodies are past each other: rows are of how they first touch, and stay.
            if (hit) add_row_at_impact(near, impact->toi, y_end);
            continue;
        }
        if (hit && !contact.contact.with_ground() && near.geometry.normal.dot(geometry.normal) < 0.0) {
            geometry.normal = -geometry.normal;
            geometry.distance = -geometry.distance;
        }
        add_row(near, geometry);
    }
    m_model.rows.insert(m_model.rows.end(), m_first_touches.begin(), m_first_touches.end());
}

void ModelDirection::add_row(const NearContact& near, const ContactGeometry& geometry) {
    const ZoneContact& contact = m_zone.contacts[near.contact];
    ContactRow row = make_row(m_zone, contact, geometry, m_at, m_point.y, near.wanted);
    row.contact = near.contact;
    row.range = contact.law.range.rest - contact.law.range.floor;
    row.stiffness = near.stiffness;
    row.force = m_row_force[near.contact];
    m_model.rows.push_back(std::move(row));
    add_friction_row(near, geometry);
}

void ModelDirection::add_row_at_impact(const NearContact& near, double toi, const Coordinates& y_end) {
    const ZoneContact& contact = m_zone.contacts[near.contact];
    const std::array<int, 2> bodies = {contact.a, contact.b};
    std::array<Pose, 2> poses;
    for (std::size_t k = 0; k < 2; ++k) {
        const int i = bodies[k];
        poses[k] = m_at.poses[i];
        m_at.y.bodies[i] = m_point.y.bodies[i] + toi * (y_end.bodies[i] - m_point.y.bodies[i]);
        m_at.poses[i] = pose_at(m_zone.bodies[i], m_at.y.bodies[i]);
    }
    add_row(near, contact_geometry(m_zone, contact, m_at.poses, m_at.nodes));
    m_first_touches.push_back(std::move(m_model.rows.back()));
    m_model.rows.pop_back();
    // Its friction comes in where the bodies are near each other at the beginning of a model.
    if (!m_model.friction.empty() && m_model.friction.back().normal == m_model.rows.size()) m_model.friction.pop_back();
    for (std::size_t k = 0; k < 2; ++k) {
        m_at.y.bodies[bodies[k]] = y_end.bodies[bodies[k]];
        m_at.poses[bodies[k]] = poses[k];
    }
}

/// Half the way for the bodies that are stopped.
void ModelDirection::shorten_blocked(const std::vector<Impact>& impacts, Coordinates& p) const {
    std::vector<char> body(m_zone.bodies.size(), 0), node(m_zone.nodes.size(), 0);
    for (const Impact& impact : impacts) {
        const ZoneContact& contact = m_zone.contacts[impact.contact];
        visit_movers(m_zone, contact, [&](int i) { body[i] = 1; }, [&](int i) { node[i] = 1; });
    }
    for (std::size_t i = 0; i < p.bodies.size(); ++i)
        if (body[i]) p.bodies[i] *= 0.5;
    for (std::size_t i = 0; i < p.nodes.size(); ++i)
        if (node[i] && !m_zone.nodes[i].pinned) p.nodes[i] *= 0.5;
}

/// Let the model's smooth part be the distance to this motion, in its own metric.
void ModelDirection::set_aim(const Coordinates& aim) {
    m_model.smooth.multiply(aim, m_model.gradient);
    for (Vec6& g : m_model.gradient.bodies) g = -g;
    for (Vec3& g : m_model.gradient.nodes) g = -g;
    for (int i = 0; i < m_zone.node_count(); ++i)
        if (m_zone.nodes[i].pinned) m_model.gradient.nodes[i].setZero();
}

/// The way leads out of the list of contacts: list them for it, and make the model again.
void ModelDirection::list_anew(Coordinates& y_end) {
    keep_forces();
    m_path.list_contacts(y_end);
    evaluate(m_zone, m_point);
    recall_forces();
    list_near();
    make_model();
    if (m_aim != nullptr) set_aim(*m_aim);
}

ModelDirection::Way ModelDirection::find(const Coordinates& gradient, bool driven, Coordinates& y_end) {
    Way way;
    const std::size_t body_count = static_cast<std::size_t>(m_zone.dynamic_count), node_count = m_zone.nodes.size();
    m_weight.resize(body_count + node_count, 0.0);
    Coordinates p;
    p.assign_zero(body_count, node_count);
    m_with_curvature = true;
    m_gradient = &gradient;
    m_aim = nullptr;
    m_first_touches.clear();
    recall_forces();
    advance_multipliers();
    list_near();
    if (m_near.empty() && driven && !m_zone.contacts.with_friction) return way;
    make_model();
    way.found = find_minimiser(p, way.newton_steps, y_end);
    if (!way.found) return way;
    keep_forces();
    m_way = p;
    follow(p, driven, way, y_end);
    return way;
}

/// The model's, from p = 0, with rows for all that it may violate. False where no model has one.
bool ModelDirection::find_minimiser(Coordinates& p, int& newton_steps, Coordinates& y_end) {
    bool cut_more = false;
    for (int listings = 0;;) {
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (m_zone.nodes[i].pinned) p.nodes[i] = m_zone.nodes[i].target - m_point.y.nodes[i];
        if (!solve(p, newton_steps)) {
            if (m_zone.nodes.empty()) {
                if (!m_with_curvature) return false;
                m_with_curvature = false;
            } else {
                if (!m_cut.more()) return false;
                cut_more = true;
            }
            p.assign_zero(p.bodies.size(), p.nodes.size());
            make_model();
            continue;
        }
        set_end(p, y_end);
        if (listings < kMaxListings && !m_path.covers(y_end)) {
            ++listings;
            list_anew(y_end);
            continue;
        }
        if (turns_too_far(p)) {
            make_model();
            continue;
        }
        if (add_missed(y_end)) {
            keep_forces();
            make_model();
            continue;
        }
        break;
    }
    if (!cut_more) m_cut.less();
    return true;
}

/// Go the way p as far as there is room: linearised where it ends, and shortened where that is not enough.
/// y_end: of the way with most room.
void ModelDirection::follow(Coordinates& p, bool driven, Way& way, Coordinates& y_end) {
    std::vector<Impact> impacts;
    way.free = allowed_step(m_zone, m_point, y_end, &impacts);
    Coordinates aim = p, best = y_end;
    for (int halvings = 0; way.free < 1.0 && halvings <= kMaxShortenings; ++halvings) {
        if (halvings > 0) {
            // The shortened way, moved by the rows as little as possible in the metric of the model.
            shorten_blocked(impacts, aim);
            m_aim = &aim;
            set_aim(aim);
            p = aim;
            set_end(p, y_end);
            if (!m_path.covers(y_end)) list_anew(y_end);
            allowed_step(m_zone, m_point, y_end, &impacts);
        }
        for (int round = 0; round < (m_first_touches.empty() ? kMaxRounds : kMaxFastRounds); ++round) {
            if (!solve_where_it_ends(y_end, impacts, p, way.newton_steps)) break;
            set_end(p, y_end);
            if (!m_path.covers(y_end)) list_anew(y_end);
            const double free = allowed_step(m_zone, m_point, y_end, &impacts);
            if (free > way.free) {
                way.free = free;
                best = y_end;
                m_way = p;
                if (halvings == 0) keep_forces();
            }
            if (free == 1.0) break;
        }
        way.squeezes = !driven && way.free < 1.0 && asks_for_too_much();
        if (way.squeezes) break;
    }
    y_end = best;
    for (int i = static_cast<int>(best.bodies.size()); i < m_zone.body_count(); ++i)  // joined on the way
        y_end.bodies.push_back(m_zone.bodies[i].target);
}

/// With the rows of there; without cloth, a second time without curvature.
bool ModelDirection::solve_where_it_ends(
    const Coordinates& y_end, const std::vector<Impact>& impacts, Coordinates& p, int& newton_steps) {
    linearise_at(y_end, impacts);
    if (solve(p, newton_steps)) return true;
    if (!m_zone.nodes.empty() || !m_with_curvature) return false;
    m_with_curvature = false;
    make_model();
    if (m_aim != nullptr) set_aim(*m_aim);
    linearise_at(y_end, impacts);
    p.assign_zero(p.bodies.size(), p.nodes.size());
    return solve(p, newton_steps);
}

/// Whether the model's solution is beyond some contact's floor: all that can yield has yielded, and there is no room.
bool ModelDirection::asks_for_too_much() const {
    const auto is_beyond = [](const ContactRow& row) { return row.force > row.stiffness * row.range; };
    return std::any_of(m_model.rows.begin(), m_model.rows.end(), is_beyond);
}

}  // namespace diffsim
