#include "contact/impact_direction.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "contact/impact_qp.hpp"

namespace diffsim {
namespace {

constexpr int kMaxRounds = 40;
constexpr int kMaxTurnLimits = 5;
constexpr std::size_t kRowsPerCoordinate = 4;  // more do not lead further: the sheet would have to go another way
constexpr double kNearby = 2.0;                // pairs this many contact ranges away are rows from the start
constexpr double kImpactWindow = 0.5;  // later impacts of two bodies count up to this part of the smaller radius

/// Between closed surfaces a first impact comes from outside: normals that point into a body belong to pairs hit after
/// passing through another part of it.
bool comes_from_outside(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const std::vector<Pose>& poses) {
    if (contact.contact.with_ground()) return true;
    const auto outward = [&](int body, int feature, bool is_patch) -> Vec3 {
        if (body < 0) return Vec3::Zero();  // cloth
        const CollisionMesh& mesh = zone.mesh(body);
        if (!mesh.closed) return Vec3::Zero();
        return poses[body].R * (is_patch ? mesh.patches[feature].normal : mesh.edges[feature].outward);
    };
    const Contact& c = contact.contact;
    if (c.type != ContactType::patch_vertex &&
        outward(contact.b, c.feature_b, c.type == ContactType::vertex_patch).dot(geometry.normal) < 0.0)
        return false;
    return c.type == ContactType::vertex_patch ||
           outward(contact.a, c.feature_a, c.type == ContactType::patch_vertex).dot(geometry.normal) <= 0.0;
}

/// Key of the two objects of a contact, for "first impact of two bodies".
std::pair<int, int> objects(const ZoneContact& contact) { return {contact.a, contact.b}; }

bool with_cloth(const ZoneContact& contact) { return contact.cloth_a >= 0 || contact.cloth_b >= 0; }

/// The distance that a contact's row asks for. The row has the contact's own stiffness: bodies that it leads to where contact
/// begins are pressed together by about as much as at the solution. Facets of cloth leave their rows, and would not touch.
double wanted_distance(const ZoneContact& contact, bool pushes) {
    return with_cloth(contact) && !pushes ? contact.range.landing : contact.range.rest;
}

/// Solve the QP, and again with more mass for bodies that would turn too far.
template <class Solve>
int solve_with_limited_turns(
    const Zone& zone, double max_turn, std::vector<double>& mass_factor, const Coordinates& p, Solve&& solve) {
    int newton_steps = 0;
    for (int k = 0; k < kMaxTurnLimits; ++k) {
        newton_steps += solve();
        bool limited = false;
        for (int i = 0; i < zone.dynamic_count; ++i) {
            const double turn = p.bodies[i].head<3>().norm();
            if (turn <= 1.1 * max_turn) continue;
            mass_factor[i] *= turn / max_turn;
            limited = true;
        }
        if (!limited) break;
    }
    return newton_steps;
}

/// The nodes' part of the quadratic model at a point: mass and elasticity, and their gradient with the pinned nodes at
/// their targets.
void cloth_model(const Zone& zone, const ZonePoint& point, BlockSystem& cloth, Coordinates& gradient) {
    cloth.set_pattern(cloth_pattern(zone));
    cloth.set_zero();
    if (zone.elastic) add_elastic_hessian(zone, point, kAllCut, cloth);
    std::vector<Vec3> driven(zone.nodes.size(), Vec3::Zero());
    bool any_driven = false;
    for (int i = 0; i < zone.node_count(); ++i) {
        const ZoneNode& node = zone.nodes[i];
        if (node.pinned) {
            cloth.node_diagonal(i).setIdentity();
            driven[i] = node.target - point.y.nodes[i];
            any_driven = any_driven || !driven[i].isZero(0.0);
        } else {
            cloth.node_diagonal(i).diagonal().array() += node.mass;
            gradient.nodes[i] += node.mass * (point.y.nodes[i] - node.target);
        }
    }
    if (zone.elastic) {
        const double scale = zone.dt * zone.dt;
        for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c) {
            const ZoneCloth& part = zone.cloths[c];
            const ClothParameters& parameters = (*zone.cloth_parameters)[part.id];
            const Vec3* x = point.nodes.data() + part.first_node;
            Vec3* out = gradient.nodes.data() + part.first_node;
            add_elastic_gradient(zone.cloth(c), parameters, zone.dt, part.start, x, scale, out);
            if (any_driven)
                add_elastic_hessian_product(
                    zone.cloth(c), parameters, zone.dt, part.start, x, driven.data() + part.first_node, scale, out);
        }
    }
    for (int i = 0; i < zone.node_count(); ++i)
        if (zone.nodes[i].pinned) gradient.nodes[i].setZero();
}

Coordinates difference(const Coordinates& a, const Coordinates& b) {
    Coordinates result = a;
    for (std::size_t i = 0; i < a.bodies.size(); ++i) result.bodies[i] -= b.bodies[i];
    for (std::size_t i = 0; i < a.nodes.size(); ++i) result.nodes[i] -= b.nodes[i];
    return result;
}

}  // namespace

ImpactDirection impact_direction(
    const Zone& zone, const ZonePoint& point, double max_turn, BlockSystem& system, const ImpactDirection* before) {
    const int count = zone.dynamic_count;
    const std::size_t coordinate_count = 6 * static_cast<std::size_t>(count) + 3 * zone.nodes.size();
    Coordinates gradient;
    gradient.assign_zero(static_cast<std::size_t>(count), zone.nodes.size());
    for (int i = 0; i < count; ++i)
        gradient.bodies[i] = mass_times(zone.bodies[i], point.y.bodies[i] - zone.bodies[i].target);
    BlockSystem cloth_system;
    const BlockSystem* cloth = nullptr;
    if (!zone.nodes.empty()) {
        cloth_model(zone, point, cloth_system, gradient);
        cloth = &cloth_system;
    }

    const Placement now{point.y, point.poses, point.nodes};
    const auto is_near = [&](std::size_t k, double distance) {
        const ContactRange& range = zone.contacts[k].range;
        return distance < range.rest + kNearby * (range.rest - range.floor);
    };
    std::vector<ImpactRow> rows;
    std::vector<int> row_contacts;
    std::size_t near_count = 0;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) near_count += is_near(k, point.distances[k]) ? 1 : 0;
    rows.reserve(near_count);
    const auto add = [&](std::size_t k, const ImpactRow& row) {
        rows.push_back(row);
        row_contacts.push_back(static_cast<int>(k));
    };
    auto active = point.active.begin();  // in the order of the contacts
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        if (!is_near(k, point.distances[k])) continue;
        const ZoneContact& contact = zone.contacts[k];
        while (active != point.active.end() && active->index < static_cast<int>(k)) ++active;
        const bool is_active = active != point.active.end() && active->index == static_cast<int>(k);
        const ContactGeometry geometry =
            is_active ? active->geometry : contact_geometry(zone, contact, now.poses, now.nodes);
        if (!is_near(k, geometry.distance) || geometry.sine_sq < kParallelLimit) continue;
        const bool pushes = geometry.distance < contact.range.rest;
        add(k, make_row(zone, contact, geometry, now, point.y, wanted_distance(contact, pushes)));
    }

    ImpactDirection best;
    best.step = -1.0;
    Coordinates p;
    p.resize(static_cast<std::size_t>(count), zone.nodes.size());
    for (int i = 0; i < count; ++i) p.bodies[i] = zone.bodies[i].target - point.y.bodies[i];
    for (int i = 0; i < zone.node_count(); ++i) p.nodes[i] = zone.nodes[i].target - point.y.nodes[i];
    std::vector<char> listed(zone.contacts.size(), 0);
    std::vector<Impact> impacts;
    Coordinates y_end = point.y;
    Placement impact_at = now;
    std::vector<double> mass_factor(static_cast<std::size_t>(count), 1.0);
    std::optional<ImpactForces> forces;
    if (cloth != nullptr && zone.elastic) {  // without elasticity its matrix is diagonal, and the rows' own is sparse
        forces.emplace(zone, gradient, cloth_system);
        if (before != nullptr) forces->start_from(rows, difference(before->y_end, point.y));
    }
    const auto solve_once = [&] {
        int steps = 0;
        if (forces && forces->solve(mass_factor, rows, p, steps)) return steps;
        ensure_pattern(zone, row_contacts, system);
        return solve_impact_qp(zone, gradient, mass_factor, cloth, rows, system, p);
    };
    const auto solve = [&] { return solve_with_limited_turns(zone, max_turn, mass_factor, p, solve_once); };
    int newton_steps = solve();
    for (int round = 0; round < kMaxRounds; ++round) {
        for (int i = 0; i < zone.body_count(); ++i)
            y_end.bodies[i] = i < count ? Vec6(point.y.bodies[i] + p.bodies[i]) : zone.bodies[i].target;
        for (int i = 0; i < zone.node_count(); ++i)
            y_end.nodes[i] = zone.nodes[i].pinned ? zone.nodes[i].target : Vec3(point.y.nodes[i] + p.nodes[i]);
        const double step = allowed_step(zone, point, y_end, &impacts);
        if (step > best.step) {
            best.step = step;
            best.y_end = y_end;
        }
        if (impacts.empty() || (cloth != nullptr && rows.size() > kRowsPerCoordinate * coordinate_count)) break;

        std::vector<std::pair<std::pair<int, int>, double>> first;  // first impact of each pair of bodies
        for (const Impact& impact : impacts) {
            if (with_cloth(zone.contacts[impact.contact])) continue;
            const auto key = objects(zone.contacts[impact.contact]);
            const auto found = std::find_if(first.begin(), first.end(), [&](const auto& f) { return f.first == key; });
            if (found == first.end())
                first.emplace_back(key, impact.toi);
            else
                found->second = std::min(found->second, impact.toi);
        }
        bool violated = false;  // otherwise the QP's solution is the same again
        for (const Impact& impact : impacts) {
            const ZoneContact& contact = zone.contacts[impact.contact];
            const bool ground = contact.contact.with_ground();
            double earliest = impact.toi;  // cloth gives way piece by piece: every impact is a first one
            if (!with_cloth(contact)) {
                const auto key = objects(contact);
                earliest =
                    std::find_if(first.begin(), first.end(), [&](const auto& f) { return f.first == key; })->second;
                if (listed[impact.contact] && impact.toi > earliest) continue;
                // Relative travel between the first impact of these bodies and this one.
                const int b = ground ? contact.a : contact.b;
                const double radius =
                    std::max(std::min(zone.mesh(contact.a).radius, zone.mesh(b).radius), zone.model->thickness);
                Vec6 relative = y_end.bodies[contact.a] - point.y.bodies[contact.a];
                if (!ground) relative.tail<3>() -= (y_end.bodies[b] - point.y.bodies[b]).tail<3>();
                const double travel = (impact.toi - earliest) * relative.tail<3>().norm();
                if (impact.toi > earliest && travel > kImpactWindow * radius) continue;
            }

            for (bool of_a : {true, false}) {
                if (!of_a && ground) continue;
                if ((of_a ? contact.cloth_a : contact.cloth_b) >= 0) {
                    for (int node : feature_nodes(zone, contact, of_a)) {
                        if (node < 0) continue;
                        impact_at.y.nodes[node] =
                            point.y.nodes[node] + impact.toi * (y_end.nodes[node] - point.y.nodes[node]);
                        impact_at.nodes[node] = zone.nodes[node].start + impact_at.y.nodes[node];
                    }
                } else {
                    const int i = of_a ? contact.a : contact.b;
                    impact_at.y.bodies[i] = point.y.bodies[i] + impact.toi * (y_end.bodies[i] - point.y.bodies[i]);
                    impact_at.poses[i] = pose_at(zone.bodies[i], impact_at.y.bodies[i]);
                }
            }
            const ContactGeometry geometry = contact_geometry(zone, contact, impact_at.poses, impact_at.nodes);
            if (!(geometry.distance > 0.0)) continue;
            if ((impact.toi > earliest || with_cloth(contact)) &&
                !comes_from_outside(zone, contact, geometry, impact_at.poses))
                continue;
            add(static_cast<std::size_t>(impact.contact),
                make_row(zone, contact, geometry, impact_at, point.y, wanted_distance(contact, false)));
            listed[impact.contact] = 1;
            violated = violated || row_times(rows.back(), p) < rows.back().missing;
        }
        if (!violated) break;
        newton_steps += solve();
    }
    best.newton_steps = newton_steps;
    return best;
}

}  // namespace diffsim
