#include "zone/zone_accuracy.hpp"

#include <algorithm>
#include <cmath>

#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

double scaled(const Mat3& turn_metric, double shift_metric, const Vec6& v) {
    const Vec3 turn = v.head<3>();
    return std::sqrt(turn.dot(turn_metric * turn) + shift_metric * v.tail<3>().squaredNorm());
}

}  // namespace

Accuracy accuracy(const Zone& zone, const ZoneDerivatives& derivatives, double position) {
    double residual = 0.0, reference = derivatives.largest_force;
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        const Vec6& g = derivatives.gradient.bodies[i];
        residual = std::max(residual, scaled(body.inverse_inertia, 1.0 / body.mass, g));
        reference = std::max(reference, scaled(body.inertia, body.mass, body.warm - body.target));
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        const ZoneNode& node = zone.nodes[i];
        if (node.pinned) continue;
        const double root_mass = std::sqrt(node.mass);
        residual = std::max(residual, derivatives.gradient.nodes[i].norm() / root_mass);
        reference = std::max(reference, (node.warm - node.target).norm() * root_mass);
    }
    // Nothing pushes here and nothing did before: only the exact answer will do, or a step lost in rounding.
    if (!(reference > 0.0)) return {residual > 0.0 ? 1.0 : 0.0, 0.0};
    return {residual / reference, kEpsilon * position * derivatives.largest_stiffness / reference};
}

double energy_noise(
    const Zone& zone, const ZonePoint& point, const BlockSystem& system, double position, std::vector<double>& pushed) {
    // The errors of one body's contacts may all add up. Those of different bodies are independent: their sum grows with the
    // root of their number.
    double force_sum = 0.0;
    pushed.assign(static_cast<std::size_t>(zone.dynamic_count), 0.0);
    for (const ActiveContact& active : point.active) {
        if (active.geometry.sine_sq == 0.0) continue;  // parallel edges push nothing
        const ZoneContact& contact = zone.contacts[active.index];
        const double force = normal_force(contact.law, active.geometry.distance).force;
        bool on_body = false;
        visit_movers(
            zone, contact,
            [&](int body) {
                if (!zone.yields(body)) return;
                pushed[body] += force;
                on_body = true;
            },
            [](int) {});
        if (!on_body) force_sum += force;
    }
    double square_sum = 0.0;
    for (double force : pushed) square_sum += force * force;
    force_sum += std::sqrt(square_sum);
    // The elements' forces |f| = sqrt(2 k E), by Cauchy-Schwarz Σ |f| <= sqrt(2 Σk ΣE).
    double stiffness_sum = 0.0;
    for (int i = 0; i < zone.node_count(); ++i)
        if (!zone.nodes[i].pinned) stiffness_sum += system.node_diagonal(i).trace();
    force_sum += std::sqrt(2.0 * stiffness_sum * point.elastic_energy);
    return 1e-15 * std::abs(point.energy) + 8.0 * kEpsilon * position * force_sum;
}

}  // namespace diffsim
