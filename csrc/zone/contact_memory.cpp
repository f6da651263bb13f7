#include "zone/contact_memory.hpp"

#include <algorithm>

namespace diffsim {
namespace {

bool before(const ShiftedContact& one, const ShiftedContact& other) { return comes_before(one.contact, other.contact); }

}  // namespace

void forget_contacts(Zone& zone) {
    zone.bodies.resize(static_cast<std::size_t>(zone.dynamic_count));
    zone.contacts.clear();
    zone.contacts.memory = {};
    zone.contacts.memory.compliance = zone.compliance;
}

void rescue_contacts(Zone& zone) {
    zone.contacts.memory.rescued = true;
    std::vector<Pose> poses;
    std::vector<Vec3> nodes;
    for (const ZoneBody& body : zone.bodies) poses.push_back(body.start);
    for (const ZoneNode& node : zone.nodes) nodes.push_back(node.start);
    zone.contacts.split_laws();
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        ContactRange& range = zone.contacts.laws[k].range;
        range = rescued_range(range, contact_geometry(zone, zone.contacts[k], poses, nodes).distance);
    }
}

void shift_contacts(Zone& zone, const ZonePoint& point, double stiffening) {
    ContactMemory& memory = zone.contacts.memory;
    memory.compliance /= stiffening;
    memory.shifted.clear();
    zone.contacts.split_laws();
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        ContactLaw& law = zone.contacts.laws[k];
        const double force = normal_force(law, point.distances[k]).force;
        law.stiffness.value *= stiffening;
        shift_rest(law, force);
        if (law.shift > 0.0) memory.shifted.push_back({zone.contacts[k].contact, law.shift});
    }
    std::sort(memory.shifted.begin(), memory.shifted.end(), before);
}

void recall_contacts(Zone& zone) {
    const std::vector<ShiftedContact>& shifted = zone.contacts.memory.shifted;
    if (zone.contacts.memory.rescued) rescue_contacts(zone);
    if (shifted.empty()) return;
    zone.contacts.split_laws();
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ShiftedContact key{zone.contacts[k].contact, 0.0};
        const auto found = std::lower_bound(shifted.begin(), shifted.end(), key, before);
        if (found == shifted.end() || before(key, *found)) continue;
        ContactLaw& law = zone.contacts.laws[k];
        law.shift = found->shift;
        law.range.rest += found->shift;
    }
}

}  // namespace diffsim
