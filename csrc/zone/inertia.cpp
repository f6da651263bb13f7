#include "zone/inertia.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {

double inertial_energy(const Zone& zone, const Coordinates& y) {
    double energy = 0.0;
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        const Vec6 error = y.bodies[i] - body.target;
        energy +=
            0.5 * (error.head<3>().dot(body.inertia * error.head<3>()) + body.mass * error.tail<3>().squaredNorm());
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        const ZoneNode& node = zone.nodes[i];
        if (!node.pinned) energy += 0.5 * node.mass * (y.nodes[i] - node.target).squaredNorm();
    }
    return energy;
}

namespace {

void add_node_inertia(const ZoneNode& node, const Vec3& y, Vec3& gradient, ZoneDerivatives& derivatives, Mat3* block) {
    if (node.pinned) {
        gradient.setZero();
        if (block != nullptr) block->setIdentity();
        return;
    }
    const double root_mass = std::sqrt(node.mass);
    derivatives.largest_force = std::max(derivatives.largest_force, gradient.norm() / root_mass);
    gradient += node.mass * (y - node.target);
    if (block == nullptr) return;
    derivatives.largest_stiffness = std::max(derivatives.largest_stiffness, block->trace() / root_mass);
    block->diagonal().array() += node.mass;
}

}  // namespace

void add_inertia(const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem* system) {
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        const Vec6 error = point.y.bodies[i] - body.target;
        Vec6& gradient = derivatives.gradient.bodies[i];
        gradient.head<3>() += body.inertia * error.head<3>();
        gradient.tail<3>() += body.mass * error.tail<3>();
        if (system == nullptr) continue;
        Mat6& block = system->diagonal(i);
        block.topLeftCorner<3, 3>() += body.inertia;
        block.diagonal().tail<3>().array() += body.mass;
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        Mat3* block = system != nullptr ? &system->node_diagonal(i) : nullptr;
        add_node_inertia(zone.nodes[i], point.y.nodes[i], derivatives.gradient.nodes[i], derivatives, block);
    }
}

}  // namespace diffsim
