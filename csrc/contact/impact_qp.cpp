#include "contact/impact_qp.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

constexpr int kMaxRounds = 40;
constexpr int kMaxNewtonSteps = 50;
constexpr double kLineTolerance = 1e-4;  // of the step: Newton corrects the rest
constexpr double kQpTolerance = 1e-9;    // of the starting gradient: a search direction needs no more
constexpr double kMaxTurn = 0.5;         // [rad] in one direction: rows hold their meaning over that
constexpr int kMaxTurnLimits = 5;
constexpr double kNearby = 2.0;        // pairs this many contact ranges away are rows from the start
constexpr double kImpactWindow = 0.5;  // later impacts of two bodies count up to this part of the smaller radius

double dot(const Coordinates& a, const Coordinates& b, int body_count) {
    double sum = 0.0;
    for (int i = 0; i < body_count; ++i) sum += a.bodies[i].dot(b.bodies[i]);
    for (std::size_t i = 0; i < a.nodes.size(); ++i) sum += a.nodes[i].dot(b.nodes[i]);
    return sum;
}

double row_times(const ImpactRow& row, const Coordinates& p) {
    double sum =
        (row.a >= 0 ? row.row_a.dot(p.bodies[row.a]) : 0.0) + (row.b >= 0 ? row.row_b.dot(p.bodies[row.b]) : 0.0);
    for (std::size_t k = 0; k < static_cast<std::size_t>(row.node_count); ++k)
        sum += row.node_rows[k].dot(p.nodes[row.nodes[k]]);
    return sum;
}

Vec6 mass_times(const ZoneBody& body, const Vec6& p) {
    Vec6 result;
    result << body.inertia * p.head<3>(), body.mass * p.tail<3>();
    return result;
}

/// The quadratic part of the QP times p; nothing for pinned nodes.
void model_times(
    const Zone& zone, const std::vector<double>& mass_factor, const BlockSystem* cloth, const Coordinates& p,
    Coordinates& out) {
    if (cloth != nullptr) {
        cloth->multiply(p, out);
        for (int i = 0; i < zone.node_count(); ++i)
            if (zone.nodes[i].pinned) out.nodes[i].setZero();
    }
    out.bodies.resize(static_cast<std::size_t>(zone.dynamic_count));
    for (int i = 0; i < zone.dynamic_count; ++i)
        out.bodies[i] = mass_factor[i] * mass_times(zone.bodies[i], p.bodies[i]);
}

/// Minimise the convex piecewise quadratic t -> f(p + t s) for t > 0: Newton with bisection as its guard.
double exact_line_search(
    const std::vector<double>& violation, const std::vector<double>& slope, const std::vector<ImpactRow>& rows,
    double first, double second) {
    double lower = 0.0, upper = kInfinity, t = 1.0;
    for (int k = 0; k < 60; ++k) {
        double derivative = first + t * second, curvature = second;
        for (std::size_t r = 0; r < rows.size(); ++r) {
            const double v = violation[r] - t * slope[r];
            if (v <= 0.0) continue;
            derivative -= rows[r].stiffness * v * slope[r];
            curvature += rows[r].stiffness * slope[r] * slope[r];
        }
        (derivative > 0.0 ? upper : lower) = t;
        double next = t - derivative / curvature;
        if (!(next > lower && next < upper)) next = upper < kInfinity ? 0.5 * (lower + upper) : 2.0 * t;
        if (std::abs(next - t) <= kLineTolerance * t) break;
        t = next;
    }
    return t;
}

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

/// The QP's matrix without rows, of the nodes: mass and, pattern by pattern, elasticity.
void add_cloth_model(const Zone& zone, const BlockSystem& cloth, BlockSystem& system) {
    for (int i = 0; i < zone.node_count(); ++i) system.node_diagonal(i) = cloth.node_diagonal(i);
    const IndexPairs& pairs = cloth.pattern().node_pairs;
    for (std::size_t k = 0; k < pairs.size(); ++k)
        system.node_pair(system.find_node_pair(pairs[k].first, pairs[k].second)) = cloth.node_pair(static_cast<int>(k));
}

void add_row(const Zone& zone, const ImpactRow& row, double force, Coordinates& gradient, BlockSystem& system) {
    if (row.a >= 0) {
        gradient.bodies[row.a] -= force * row.row_a;
        system.diagonal(row.a) += row.stiffness * row.row_a * row.row_a.transpose();
    }
    if (row.b >= 0) {
        gradient.bodies[row.b] -= force * row.row_b;
        system.diagonal(row.b) += row.stiffness * row.row_b * row.row_b.transpose();
    }
    if (row.a >= 0 && row.b >= 0) system.off_diagonal(row.pair) += row.stiffness * row.row_a * row.row_b.transpose();
    for (std::size_t k = 0; k < static_cast<std::size_t>(row.node_count); ++k) {
        const int node = row.nodes[k];
        gradient.nodes[node] -= force * row.node_rows[k];
        for (std::size_t l = k; l < static_cast<std::size_t>(row.node_count); ++l)
            add_node_block(
                zone, node, row.nodes[l], row.stiffness * row.node_rows[k] * row.node_rows[l].transpose(), system);
        if (row.a >= 0)
            system.mixed_pair(system.find_mixed_pair(row.a, node)) +=
                row.stiffness * row.row_a * row.node_rows[k].transpose();
    }
}

}  // namespace

ImpactRow make_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now, double wanted) {
    ImpactRow row;
    row.pair = contact.pair;
    row.stiffness = contact.stiffness.value;
    row.missing = wanted - geometry.distance;
    const auto add_body = [&](int body, const Vec3& point, const Vec3& normal, int& slot, Vec6& out) {
        Vec6 twist;
        twist << (point - at.poses[body].t).cross(normal), normal;
        const Vec6& y = at.y.bodies[body];
        out = chart_jacobian(y).transpose() * twist;
        if (zone.yields(body)) {
            slot = body;
            row.missing += out.dot(y - y_now.bodies[body]);
        } else {
            row.missing -= out.dot(zone.bodies[body].target - y);
        }
    };
    const auto add_cloth = [&](bool of_a, const Vec3& normal) {
        const Surface surface =
            of_a ? surface_a(zone, contact, at.poses, at.nodes) : surface_b(zone, contact, at.poses, at.nodes);
        const Vec3 weights = cloth_side(contact.contact, geometry, surface, of_a).weights;
        const std::array<int, 3> nodes = feature_nodes(zone, contact, of_a);
        for (int k = 0; k < 3; ++k) {
            const int node = nodes[static_cast<std::size_t>(k)];
            if (node < 0 || weights[k] == 0.0) continue;
            const Vec3 part = weights[k] * normal;
            if (zone.nodes[node].pinned) {
                row.missing -= part.dot(zone.nodes[node].target - at.y.nodes[node]);
                continue;
            }
            row.missing += part.dot(at.y.nodes[node] - y_now.nodes[node]);
            row.nodes[static_cast<std::size_t>(row.node_count)] = node;
            row.node_rows[static_cast<std::size_t>(row.node_count)] = part;
            ++row.node_count;
        }
    };
    if (contact.cloth_a >= 0)
        add_cloth(true, geometry.normal);
    else
        add_body(contact.a, geometry.closest.point_a, geometry.normal, row.a, row.row_a);
    if (contact.contact.with_ground()) return row;
    if (contact.cloth_b >= 0)
        add_cloth(false, -geometry.normal);
    else
        add_body(contact.b, geometry.closest.point_b, -geometry.normal, row.b, row.row_b);
    return row;
}

int solve_impact_qp(
    const Zone& zone, const Coordinates& model_gradient, const std::vector<double>& mass_factor,
    const BlockSystem* cloth, const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p) {
    const int count = zone.dynamic_count;
    Coordinates gradient, step, model_step;
    gradient.assign_zero(static_cast<std::size_t>(count), zone.nodes.size());
    step = gradient;
    std::vector<double> violation(rows.size()), slope(rows.size());
    double first_norm = -1.0;
    int k = 0;
    for (; k < kMaxNewtonSteps; ++k) {
        system.set_zero();
        model_times(zone, mass_factor, cloth, p, gradient);
        for (int i = 0; i < count; ++i) {
            const ZoneBody& body = zone.bodies[i];
            gradient.bodies[i] += model_gradient.bodies[i];
            system.diagonal(i).topLeftCorner<3, 3>() = mass_factor[i] * body.inertia;
            system.diagonal(i).diagonal().tail<3>().setConstant(mass_factor[i] * body.mass);
        }
        for (int i = 0; i < zone.node_count(); ++i) gradient.nodes[i] += model_gradient.nodes[i];
        if (cloth != nullptr) add_cloth_model(zone, *cloth, system);
        for (std::size_t r = 0; r < rows.size(); ++r) {
            violation[r] = rows[r].missing - row_times(rows[r], p);
            if (violation[r] > 0.0) add_row(zone, rows[r], rows[r].stiffness * violation[r], gradient, system);
        }
        const double norm = std::sqrt(dot(gradient, gradient, count));
        if (first_norm < 0.0) first_norm = norm;
        if (!(norm > kQpTolerance * first_norm)) break;
        if (!system.factorize()) break;
        for (int i = 0; i < count; ++i) step.bodies[i] = -gradient.bodies[i];
        for (int i = 0; i < zone.node_count(); ++i) step.nodes[i] = -gradient.nodes[i];
        system.solve_in_place(step);
        for (std::size_t r = 0; r < rows.size(); ++r) slope[r] = row_times(rows[r], step);
        // Slope and curvature of the quadratic part along the step.
        model_times(zone, mass_factor, cloth, step, model_step);
        const double first = dot(step, model_gradient, count) + dot(model_step, p, count);
        const double second = dot(model_step, step, count);
        if (!(second > 0.0)) break;
        const double t = exact_line_search(violation, slope, rows, first, second);
        for (int i = 0; i < count; ++i) p.bodies[i] += t * step.bodies[i];
        for (int i = 0; i < zone.node_count(); ++i) p.nodes[i] += t * step.nodes[i];
    }
    return k;
}

namespace {

/// Solve the QP, and again with more mass for bodies that would turn too far.
int solve_with_limited_turns(
    const Zone& zone, const Coordinates& gradient, std::vector<double>& mass_factor, const BlockSystem* cloth,
    const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p) {
    int newton_steps = 0;
    for (int k = 0; k < kMaxTurnLimits; ++k) {
        newton_steps += solve_impact_qp(zone, gradient, mass_factor, cloth, rows, system, p);
        bool limited = false;
        for (int i = 0; i < zone.dynamic_count; ++i) {
            const double turn = p.bodies[i].head<3>().norm();
            if (turn <= 1.1 * kMaxTurn) continue;
            mass_factor[i] *= turn / kMaxTurn;
            limited = true;
        }
        if (!limited) break;
    }
    return newton_steps;
}

/// The nodes' part of the quadratic model at a point: mass and elasticity, and their gradient with the pinned nodes at
/// their targets.
void cloth_model(const Zone& zone, const ZonePoint& point, BlockSystem& cloth, Coordinates& gradient) {
    BlockPattern pattern = base_pattern(zone);
    pattern.body_count = 0;
    pattern.body_pairs.clear();
    cloth.set_pattern(std::move(pattern));
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

}  // namespace

ImpactDirection impact_direction(const Zone& zone, const ZonePoint& point, BlockSystem& system) {
    const int count = zone.dynamic_count;
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
    std::vector<ImpactRow> rows;
    std::vector<int> row_contacts;
    const auto add = [&](std::size_t k, const ImpactRow& row) {
        rows.push_back(row);
        row_contacts.push_back(static_cast<int>(k));
    };
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        const double nearby = contact.range.rest + kNearby * (contact.range.rest - contact.range.floor);
        if (!(point.distances[k] < nearby)) continue;
        const ContactGeometry geometry = contact_geometry(
            contact.contact, surface_a(zone, contact, now.poses, now.nodes),
            surface_b(zone, contact, now.poses, now.nodes), zone.ground_height);
        if (geometry.sine_sq < kParallelLimit) continue;
        const bool pushes = geometry.distance < contact.range.rest;
        add(k, make_row(zone, contact, geometry, now, point.y, pushes ? contact.range.rest : contact.range.landing));
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
    const auto solve = [&] {
        ensure_pattern(zone, row_contacts, system);
        return solve_with_limited_turns(zone, gradient, mass_factor, cloth, rows, system, p);
    };
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
        if (impacts.empty()) break;

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
        bool added = false;
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
            const ContactGeometry geometry = contact_geometry(
                contact.contact, surface_a(zone, contact, impact_at.poses, impact_at.nodes),
                surface_b(zone, contact, impact_at.poses, impact_at.nodes), zone.ground_height);
            if (!(geometry.distance > 0.0)) continue;
            if ((impact.toi > earliest || with_cloth(contact)) &&
                !comes_from_outside(zone, contact, geometry, impact_at.poses))
                continue;
            add(static_cast<std::size_t>(impact.contact),
                make_row(zone, contact, geometry, impact_at, point.y, contact.range.landing));
            listed[impact.contact] = 1;
            added = true;
        }
        if (!added) break;
        newton_steps += solve();
    }
    best.newton_steps = newton_steps;
    return best;
}

}  // namespace diffsim
