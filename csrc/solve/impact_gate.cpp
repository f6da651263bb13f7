#include "solve/impact_gate.hpp"

#include <algorithm>

namespace diffsim {
namespace {

constexpr double kPassingPart = 0.5;  // of the smaller body's radius
constexpr double kFastPart = 1.5;     // boxes pass each other from there on

double size(const Zone& zone, int body) {
    return zone.mesh(body).radius + zone.model->bodies[zone.bodies[body].id].margin;
}

/// A point of space in a body's frame at its coordinates.
Vec3 in_body(const Zone& zone, int body, const Vec6& y, const Vec3& point) {
    const Pose pose = pose_at(zone.bodies[body], y);
    return pose.R.transpose() * (point - pose.t);
}

/// How far along a gate's normal its points and the bodies' centres are apart.
struct Passage {
    double points, centers;
};

Passage passage(const ImpactGate& gate, const Zone& zone, const Coordinates& y) {
    const Pose a = pose_at(zone.bodies[gate.a], y.bodies[gate.a]), b = pose_at(zone.bodies[gate.b], y.bodies[gate.b]);
    return {gate.normal.dot(a * gate.point_a - b * gate.point_b), gate.normal.dot(a.t - b.t)};
}

}  // namespace

bool may_pass(const Zone& zone, const Coordinates& y_end) {
    double smallest = kInfinity, furthest = 0.0;
    for (int i = 0; i < zone.body_count(); ++i) {
        smallest = std::min(smallest, size(zone, i));
        furthest = std::max(furthest, y_end.bodies[i].tail<3>().norm());
    }
    return 2.0 * furthest > kPassingPart * smallest;
}

std::vector<ImpactGate> find_impact_gates(const Zone& zone, const ZonePoint& point, const Coordinates& y_end) {
    std::vector<ImpactGate> gates;
    std::vector<Impact> impacts;
    allowed_step(zone, point, y_end, &impacts);
    std::stable_sort(impacts.begin(), impacts.end(), [](const Impact& first, const Impact& second) {
        return first.toi < second.toi;
    });
    for (const Impact& impact : impacts) {
        const ZoneContact& contact = zone.contacts[impact.contact];
        if (contact.contact.with_ground()) continue;  // there is no way around a half-space
        if (contact.has_cloth()) continue;            // cloth is led around things, and gives way
        const int a = contact.a, b = contact.b;
        const auto same = [&](const ImpactGate& gate) { return gate.a == a && gate.b == b; };
        if (std::any_of(gates.begin(), gates.end(), same)) continue;
        const double radius = std::min(size(zone, a), size(zone, b));
        const double passing = kPassingPart * radius;
        const Vec6 relative = (y_end.bodies[a] - point.y.bodies[a]) - (y_end.bodies[b] - point.y.bodies[b]);
        const double travel = relative.tail<3>().norm();
        if (travel <= passing) continue;
        const Vec6 y_a = point.y.bodies[a] + impact.toi * (y_end.bodies[a] - point.y.bodies[a]);
        const Vec6 y_b = point.y.bodies[b] + impact.toi * (y_end.bodies[b] - point.y.bodies[b]);
        const Pose pose_a = pose_at(zone.bodies[a], y_a), pose_b = pose_at(zone.bodies[b], y_b);
        const ContactGeometry geometry =
            contact_geometry(*zone.model, contact.contact, pose_a, pose_b, zone.ground_height);
        ImpactGate gate;
        gate.a = a;
        gate.b = b;
        gate.point_a = in_body(zone, a, y_a, geometry.closest.a.point);
        gate.point_b = in_body(zone, b, y_b, geometry.closest.b.point);
        gate.normal = geometry.normal;
        const Passage start = passage(gate, zone, point.y);
        gate.least_points = std::min(start.points, contact.law.range.rest) - passing;
        gate.least_centers = std::min(start.centers, geometry.normal.dot(pose_a.t - pose_b.t)) - 2.0 * passing;
        gate.fast = travel > kFastPart * radius;
        gates.push_back(gate);
    }
    return gates;
}

bool gates_hold(const std::vector<ImpactGate>& gates, const Zone& zone, const Coordinates& y) {
    return std::all_of(gates.begin(), gates.end(), [&](const ImpactGate& gate) {
        const Passage now = passage(gate, zone, y);
        return now.points >= gate.least_points && now.centers >= gate.least_centers;
    });
}

}  // namespace diffsim
