#include "zone/zone_accuracy.hpp"

#include <algorithm>
#include <cmath>

#include "zone/contacts.hpp"
#include "zone/elasticity.hpp"

namespace diffsim {
namespace {

double scaled(const Mat3& turn_metric, double shift_metric, const Vec6& v) {
    const Vec3 turn = v.head<3>();
    return std::sqrt(turn.dot(turn_metric * turn) + shift_metric * v.tail<3>().squaredNorm());
}

}  // namespace

double largest_scaled(const Zone& zone, const Coordinates& g) {
    double largest = 0.0;
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        largest = std::max(largest, scaled(body.inverse_inertia, 1.0 / body.mass, g.bodies[i]));
    }
    for (int i = 0; i < zone.node_count(); ++i)
        if (!zone.nodes[i].pinned) largest = std::max(largest, g.nodes[i].norm() / std::sqrt(zone.nodes[i].mass));
    return largest;
}

double largest_motion(const Zone& zone, const Coordinates& p) {
    double largest = 0.0;
    for (int i = 0; i < zone.dynamic_count; ++i)
        largest = std::max(largest, scaled(zone.bodies[i].inertia, zone.bodies[i].mass, p.bodies[i]));
    for (int i = 0; i < zone.node_count(); ++i)
        if (!zone.nodes[i].pinned) largest = std::max(largest, p.nodes[i].norm() * std::sqrt(zone.nodes[i].mass));
    return largest;
}

Accuracy accuracy(const Zone& zone, const ZoneDerivatives& derivatives, double position) {
    const double residual = largest_scaled(zone, derivatives.gradient);
    double reference = derivatives.largest_force;
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        reference = std::max(reference, scaled(body.inertia, body.mass, body.last_motion - body.target));
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        const ZoneNode& node = zone.nodes[i];
        if (node.pinned) continue;
        const double root_mass = std::sqrt(node.mass);
        reference = std::max(reference, (node.last_motion - node.target).norm() * root_mass);
    }
    // Nothing pushes here and nothing did before: only the exact answer will do, or what rounding makes of a contact
    // that is at its rest distance.
    if (!(reference > 0.0)) reference = residual;
    if (!(reference > 0.0)) return {0.0, 0.0, 0.0};
    return {residual / reference, kEpsilon * position * derivatives.largest_stiffness / reference, reference};
}

double energy_noise(
    const Zone& zone, const ZonePoint& point, const BlockSystem& system, double position, std::vector<double>& pushed) {
    double force_sum = contact_force_sum(zone, point, pushed);
    force_sum += elastic_force_sum(zone, point, system);
    return 1e-15 * std::abs(point.energy) + 8.0 * kEpsilon * position * force_sum;
}

}  // namespace diffsim
