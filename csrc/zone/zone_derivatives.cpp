#include "zone/zone_derivatives.hpp"

#include "zone/chart.hpp"
#include "zone/contacts.hpp"
#include "zone/elasticity.hpp"
#include "zone/inertia.hpp"

namespace diffsim {

void add_node_block(const Zone& zone, int i, int j, const Mat3& block, BlockSystem& system) {
    if (zone.nodes[i].pinned || zone.nodes[j].pinned) return;
    if (i == j)
        system.node_diagonal(i) += block;
    else if (i < j)
        system.node_pair(system.find_node_pair(i, j)) += block;
    else
        system.node_pair(system.find_node_pair(j, i)) += block.transpose();
}

BlockPattern base_pattern(const Zone& zone) {
    BlockPattern pattern = elastic_pattern(zone);
    pattern.body_count = zone.dynamic_count;
    pattern.body_pairs = zone.contacts.blocks;
    return pattern;
}

namespace {

void set_zero(const Zone& zone, ZoneDerivatives& derivatives) {
    derivatives.gradient.assign_zero(static_cast<std::size_t>(zone.dynamic_count), zone.nodes.size());
    derivatives.pair_sums.clear();
    derivatives.largest_force = derivatives.largest_stiffness = 0.0;
}

}  // namespace

void differentiate(
    const Zone& zone, const ZonePoint& point, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system,
    CutShare cut) {
    set_zero(zone, derivatives);
    if (curvature == Curvature::none) system = nullptr;
    if (system != nullptr) {
        if (!zone.nodes.empty()) {
            std::vector<int> indices;
            for (const ActiveContact& active : point.active) indices.push_back(active.index);
            ensure_pattern(zone, indices, *system);
        }
        system->set_zero();
    }
    add_contact_derivatives(zone, point, curvature, cut, derivatives, system);
    to_coordinates(zone, point, curvature, cut, derivatives, system);
    add_elasticity(zone, point, cut, derivatives, system);
    add_inertia(zone, point, derivatives, system);
}

void differentiate_smooth(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut,
    ZoneDerivatives& derivatives, BlockSystem& system) {
    set_zero(zone, derivatives);
    system.set_zero();
    add_contact_curvature(zone, point, pushing, cut, derivatives, system);
    to_coordinates(zone, point, Curvature::full, cut, derivatives, &system);
    add_elasticity(zone, point, cut, derivatives, &system);
    add_inertia(zone, point, derivatives, &system);
}

}  // namespace diffsim
