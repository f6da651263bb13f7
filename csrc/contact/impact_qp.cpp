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

double dot(const Coordinates& a, const Coordinates& b, int count) {
    double sum = 0.0;
    for (int i = 0; i < count; ++i) sum += a[i].dot(b[i]);
    return sum;
}

double row_times(const ImpactRow& row, const Coordinates& p) {
    return (row.a >= 0 ? row.row_a.dot(p[row.a]) : 0.0) + (row.b >= 0 ? row.row_b.dot(p[row.b]) : 0.0);
}

Vec6 mass_times(const ZoneBody& body, const Vec6& p) {
    Vec6 result;
    result << body.inertia * p.head<3>(), body.mass * p.tail<3>();
    return result;
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

ImpactRow make_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const std::vector<Pose>& poses,
    const Coordinates& y) {
    const Vec3 no_center = Vec3::Zero();
    const bool ground = contact.contact.with_ground();
    const Vec12 row = distance_gradient(geometry, poses[contact.a].t, ground ? no_center : poses[contact.b].t);
    ImpactRow result;
    result.a = contact.a < zone.dynamic_count ? contact.a : -1;
    result.b = !ground && contact.b < zone.dynamic_count ? contact.b : -1;
    result.pair = contact.pair;
    result.row_a = chart_jacobian(y[contact.a]).transpose() * row.head<6>();
    if (!ground) result.row_b = chart_jacobian(y[contact.b]).transpose() * row.tail<6>();
    result.stiffness = contact.stiffness.value;
    return result;
}

/// Between closed surfaces a first impact comes from outside: normals that point into a body belong to pairs hit after
/// passing through another part of it.
bool comes_from_outside(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const std::vector<Pose>& poses) {
    if (contact.contact.with_ground()) return true;
    const auto outward = [&](int body, int feature, bool is_patch) -> Vec3 {
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

}  // namespace

int solve_impact_qp(
    const Zone& zone, const Coordinates& inertial_gradient, const std::vector<double>& mass_factor,
    const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p) {
    const int count = zone.dynamic_count;
    Coordinates gradient(static_cast<std::size_t>(count)), step(static_cast<std::size_t>(count));
    std::vector<double> violation(rows.size()), slope(rows.size());
    double first_norm = -1.0;
    int k = 0;
    for (; k < kMaxNewtonSteps; ++k) {
        system.set_zero();
        for (int i = 0; i < count; ++i) {
            const ZoneBody& body = zone.bodies[i];
            gradient[i] = mass_factor[i] * mass_times(body, p[i]) + inertial_gradient[i];
            system.diagonal(i).topLeftCorner<3, 3>() = mass_factor[i] * body.inertia;
            system.diagonal(i).diagonal().tail<3>().setConstant(mass_factor[i] * body.mass);
        }
        for (std::size_t r = 0; r < rows.size(); ++r) {
            const ImpactRow& row = rows[r];
            violation[r] = row.missing - row_times(row, p);
            if (violation[r] <= 0.0) continue;
            const double force = row.stiffness * violation[r];
            if (row.a >= 0) {
                gradient[row.a] -= force * row.row_a;
                system.diagonal(row.a) += row.stiffness * row.row_a * row.row_a.transpose();
            }
            if (row.b >= 0) {
                gradient[row.b] -= force * row.row_b;
                system.diagonal(row.b) += row.stiffness * row.row_b * row.row_b.transpose();
            }
            if (row.a >= 0 && row.b >= 0)
                system.off_diagonal(row.pair) += row.stiffness * row.row_a * row.row_b.transpose();
        }
        const double norm = std::sqrt(dot(gradient, gradient, count));
        if (first_norm < 0.0) first_norm = norm;
        if (!(norm > kQpTolerance * first_norm)) break;
        if (!system.factorize()) break;
        for (int i = 0; i < count; ++i) step[i] = -gradient[i];
        system.solve_in_place(step);
        for (std::size_t r = 0; r < rows.size(); ++r) slope[r] = row_times(rows[r], step);
        double first = 0.0, second = 0.0;  // of the inertial part along the step
        for (int i = 0; i < count; ++i) {
            const Vec6 mass_step = mass_factor[i] * mass_times(zone.bodies[i], step[i]);
            first += step[i].dot(inertial_gradient[i]) + p[i].dot(mass_step);
            second += step[i].dot(mass_step);
        }
        if (!(second > 0.0)) break;
        const double t = exact_line_search(violation, slope, rows, first, second);
        for (int i = 0; i < count; ++i) p[i] += t * step[i];
    }
    return k;
}

namespace {

/// Solve the QP, and again with more mass for bodies that would turn too far.
int solve_with_limited_turns(
    const Zone& zone, const Coordinates& inertial_gradient, std::vector<double>& mass_factor,
    const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p) {
    int newton_steps = 0;
    for (int k = 0; k < kMaxTurnLimits; ++k) {
        newton_steps += solve_impact_qp(zone, inertial_gradient, mass_factor, rows, system, p);
        bool limited = false;
        for (int i = 0; i < zone.dynamic_count; ++i) {
            const double turn = p[i].head<3>().norm();
            if (turn <= 1.1 * kMaxTurn) continue;
            mass_factor[i] *= turn / kMaxTurn;
            limited = true;
        }
        if (!limited) break;
    }
    return newton_steps;
}

}  // namespace

ImpactDirection impact_direction(const Zone& zone, const ZonePoint& point, BlockSystem& system) {
    const int count = zone.dynamic_count;
    const std::size_t total = static_cast<std::size_t>(zone.body_count());
    Coordinates inertial_gradient(static_cast<std::size_t>(count));
    for (int i = 0; i < count; ++i)
        inertial_gradient[i] = mass_times(zone.bodies[i], point.y[i] - zone.bodies[i].target);

    std::vector<ImpactRow> rows;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        const double nearby = contact.range.rest + kNearby * (contact.range.rest - contact.range.floor);
        if (!(point.distances[k] < nearby)) continue;
        const bool ground = contact.contact.with_ground();
        const Pose& pose_a = point.poses[contact.a];
        const ContactGeometry geometry = contact_geometry(
            *zone.model, contact.contact, pose_a, ground ? pose_a : point.poses[contact.b], zone.ground_height);
        if (geometry.sine_sq < kParallelLimit) continue;
        ImpactRow row = make_row(zone, contact, geometry, point.poses, point.y);
        const bool pushes = geometry.distance < contact.range.rest;
        row.missing = (pushes ? contact.range.rest : contact.range.landing) - geometry.distance;
        // Where the partner is driven, its motion is given.
        if (row.a < 0) row.missing -= row.row_a.dot(zone.bodies[contact.a].target - point.y[contact.a]);
        if (!ground && row.b < 0) row.missing -= row.row_b.dot(zone.bodies[contact.b].target - point.y[contact.b]);
        rows.push_back(row);
    }

    ImpactDirection best;
    best.step = -1.0;
    Coordinates p(static_cast<std::size_t>(count), Vec6::Zero());
    for (int i = 0; i < count; ++i) p[i] = zone.bodies[i].target - point.y[i];
    std::vector<char> listed(zone.contacts.size(), 0);
    std::vector<Impact> impacts;
    Coordinates y_end(total), y_impact(total);
    std::vector<Pose> poses(total);
    std::vector<double> mass_factor(static_cast<std::size_t>(count), 1.0);
    int newton_steps = solve_with_limited_turns(zone, inertial_gradient, mass_factor, rows, system, p);
    for (int round = 0; round < kMaxRounds; ++round) {
        for (int i = 0; i < zone.body_count(); ++i)
            y_end[i] = i < count ? Vec6(point.y[i] + p[i]) : zone.bodies[i].target;
        const double step = allowed_step(zone, point, y_end, &impacts);
        if (step > best.step) {
            best.step = step;
            best.y_end = y_end;
        }
        if (impacts.empty()) break;

        std::vector<std::pair<std::pair<int, int>, double>> first;  // first impact of each pair of bodies
        for (const Impact& impact : impacts) {
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
            const auto key = objects(contact);
            const double earliest =
                std::find_if(first.begin(), first.end(), [&](const auto& f) { return f.first == key; })->second;
            const bool ground = contact.contact.with_ground();
            if (listed[impact.contact] && impact.toi > earliest) continue;
            // Relative travel between the first impact of these bodies and this one.
            const int b = ground ? contact.a : contact.b;
            const double radius =
                std::max(std::min(zone.mesh(contact.a).radius, zone.mesh(b).radius), zone.model->thickness);
            Vec6 relative = y_end[contact.a] - point.y[contact.a];
            if (!ground) relative.tail<3>() -= (y_end[b] - point.y[b]).tail<3>();
            const double travel = (impact.toi - earliest) * relative.tail<3>().norm();
            if (impact.toi > earliest && travel > kImpactWindow * radius) continue;

            for (int i : {contact.a, b}) {
                y_impact[i] = point.y[i] + impact.toi * (y_end[i] - point.y[i]);
                poses[i] = pose_at(zone.bodies[i], y_impact[i]);
            }
            const ContactGeometry geometry =
                contact_geometry(*zone.model, contact.contact, poses[contact.a], poses[b], zone.ground_height);
            if (!(geometry.distance > 0.0)) continue;
            if (impact.toi > earliest && !comes_from_outside(zone, contact, geometry, poses)) continue;
            ImpactRow row = make_row(zone, contact, geometry, poses, y_impact);
            // distance + row (p - p_impact) >= landing, p counted from the current point
            row.missing = contact.range.landing - geometry.distance;
            const auto account = [&](int body, const Vec6& r, bool yields) {
                row.missing +=
                    yields ? r.dot(y_impact[body] - point.y[body]) : -r.dot(zone.bodies[body].target - y_impact[body]);
            };
            account(contact.a, row.row_a, row.a >= 0);
            if (!ground) account(contact.b, row.row_b, row.b >= 0);
            rows.push_back(row);
            listed[impact.contact] = 1;
            added = true;
        }
        if (!added) break;
        newton_steps += solve_with_limited_turns(zone, inertial_gradient, mass_factor, rows, system, p);
    }
    best.newton_steps = newton_steps;
    return best;
}

}  // namespace diffsim
