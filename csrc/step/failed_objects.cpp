#include "step/failed_objects.hpp"

#include <algorithm>
#include <functional>
#include <utility>

#include "zone/zone_derivatives.hpp"

namespace diffsim {
namespace {

constexpr std::size_t kMaxNamed = 8;  // objects of a zone that is not solved: a reader looks at no more

/// Squared length of the force that is left on an object, in the metric of the inverse masses: |L⁻¹ g|², M = L Lᵀ. That
/// of a cloth is its worst node's.
std::vector<std::pair<double, int>> unbalanced_forces(const Zone& zone, const ZonePoint& point) {
    ZoneDerivatives derivatives;
    differentiate(zone, point, Curvature::none, derivatives, nullptr);
    std::vector<std::pair<double, int>> forces;
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const Vec6& g = derivatives.gradient.bodies[i];
        forces.emplace_back(g.dot(inverse_mass_times(zone.bodies[i], g)), zone.bodies[i].id);
    }
    for (const ZoneCloth& cloth : zone.cloths) {
        double largest = 0.0;
        for (int k = 0; k < zone.model->cloths[cloth.id].node_count(); ++k) {
            const int node = cloth.first_node + k;
            if (!zone.nodes[node].pinned)
                largest = std::max(largest, derivatives.gradient.nodes[node].squaredNorm() / zone.nodes[node].mass);
        }
        forces.emplace_back(largest, zone.model->body_count() + cloth.id);
    }
    return forces;
}

}  // namespace

std::vector<int> unbalanced_objects(const Zone& zone, const ZonePoint& point) {
    std::vector<std::pair<double, int>> forces;
    if (static_cast<std::size_t>(zone.dynamic_count) + zone.cloths.size() <= kMaxNamed) {
        for (int i = 0; i < zone.dynamic_count; ++i) forces.emplace_back(0.0, zone.bodies[i].id);
        for (const ZoneCloth& cloth : zone.cloths) forces.emplace_back(0.0, zone.model->body_count() + cloth.id);
    } else {
        forces = unbalanced_forces(zone, point);
        std::sort(forces.begin(), forces.end(), std::greater<>());
        forces.resize(kMaxNamed);
    }
    std::vector<int> objects;
    for (const auto& [force, object] : forces) objects.push_back(object);
    std::sort(objects.begin(), objects.end());
    return objects;
}

std::vector<int> squeezed_objects(const Zone& zone, const ZonePoint& point, const std::vector<int>& blocked) {
    std::vector<int> objects = blocked;
    const auto held = [&](int object) { return std::find(objects.begin(), objects.end(), object) != objects.end(); };
    const auto passes_on = [&](int object) {  // what does not yield ends a squeeze; only the drive begins one
        return zone.model->is_cloth(object) || zone.model->bodies[object].is_dynamic() ||
               std::find(blocked.begin(), blocked.end(), object) != blocked.end();
    };
    for (bool grown = true; grown;) {
        grown = false;
        for (const ActiveContact& active : point.active) {
            const Contact& contact = zone.contacts[active.index].contact;
            if (contact.with_ground()) continue;
            for (const auto& [from, to] :
                 {std::pair(contact.object_a, contact.object_b), std::pair(contact.object_b, contact.object_a)}) {
                if (!held(from) || !passes_on(from) || held(to)) continue;
                objects.push_back(to);
                grown = true;
            }
        }
    }
    std::sort(objects.begin(), objects.end());
    return objects;
}

}  // namespace diffsim
