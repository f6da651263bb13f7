#include "step/group_step.hpp"

#include <algorithm>
#include <utility>

#include "model/number_text.hpp"
#include "step/cloth_step.hpp"
#include "step/failed_objects.hpp"

namespace diffsim {
namespace {

std::uint64_t pack(int high, std::uint32_t low) { return (static_cast<std::uint64_t>(high) << 32) ^ low; }

/// `friction`: of the zone, empty where it has none; null in scenes without.
void keep_contacts(
    const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>* friction, GroupOutcome& outcome,
    GroupResults& results) {
    outcome.first_contact = static_cast<int>(results.contacts.size());
    const auto pair_of = [&](const ActiveContact& active) {
        return zone.contacts.contacts[static_cast<std::size_t>(active.index)].pair;
    };
    int held = 0;  // contacts of the pair at hand that stick
    for (std::size_t k = 0; k < point.active.size(); ++k) {
        const ActiveContact& active = point.active[k];
        const ZoneContact& contact = zone.contacts[active.index];
        const Contact& c = contact.contact;
        if (friction != nullptr) results.friction.push_back(friction->empty() ? ContactFriction() : (*friction)[k]);
        const ContactLaw& law = contact.law;
        results.contacts.push_back(c);
        results.exact.push_back({law.shift, zone.contacts.memory.compliance});
        outcome.max_compression =
            std::max(outcome.max_compression, law.range.rest - law.shift - active.geometry.distance);
        std::uint64_t& hash = outcome.signature;
        hash = mix(hash, pack(c.object_a, static_cast<std::uint32_t>(c.object_b)));
        hash = mix(hash, pack(c.feature_a, static_cast<std::uint32_t>(c.feature_b)));
        hash = mix(hash, pack(static_cast<int>(c.type), active.geometry.closest.feature_code));
        if (friction == nullptr) continue;
        if (law.friction > 0.0) ++(results.friction.back().slips ? outcome.slipping : held);
        const bool ends_pair = k + 1 == point.active.size() || pair_of(point.active[k + 1]) != pair_of(active);
        if (!ends_pair) continue;
        // Which of a face's contacts are at their bounds is rounding's choice: two that stick hold all of it.
        hash = mix(hash, static_cast<std::uint64_t>(std::min(held, 2)));
        outcome.sticking += std::exchange(held, 0);
    }
    outcome.contact_end = static_cast<int>(results.contacts.size());
}

/// Who the failure is about, and drives that did not reach their targets.
void keep_failure(int root, const Zone& zone, const ZonePoint& point, GroupResults& results) {
    std::vector<int> blocked;
    for (int k = zone.dynamic_count; k < zone.body_count(); ++k) {
        if (point.y.bodies[k] == zone.bodies[k].target) continue;
        results.blocked.push_back({root, zone.bodies[k].id, point.y.bodies[k]});
        blocked.push_back(zone.bodies[k].id);
    }
    results.failed.push_back(
        {root, blocked.empty() ? unbalanced_objects(zone, point) : squeezed_objects(zone, point, blocked)});
}

}  // namespace

std::uint64_t mix(std::uint64_t hash, std::uint64_t value) {
    hash ^= value + 0x9e3779b97f4a7c15ull + (hash << 6) + (hash >> 2);
    return hash * 0xff51afd7ed558ccdull;
}

GroupOutcome GroupStep::solve(
    const ObjectGroup& group, const std::vector<int>& members, const Objects& objects, ThreadMemory& memory) const {
    Zone& zone = new_zone(
        memory.zone, m_model.is_cloth(group.root) ? m_state.node_position[m_model.cloth_of(group.root).first_node]
                                                  : objects.bodies[group.root].start.t);
    join(group, members, objects, zone);
    GroupOutcome outcome;
    outcome.solved = true;
    outcome.result = solve_zone(zone, objects.passive, zone_options(), memory.zone.workspace, memory.zone.swept);
    const ZonePoint& point = memory.zone.workspace.point;
    if (outcome.result.status == StepStatus::bad_start)
        refuse_start(zone.contacts[outcome.result.worst_contact], point.distances[outcome.result.worst_contact]);
    write_motion(group, members, memory.zone, objects);
    keep_contacts(
        zone, point, m_parameters.friction.empty() ? nullptr : &memory.zone.workspace.friction, outcome,
        memory.results);
    if (outcome.result.status != StepStatus::converged) keep_failure(group.root, zone, point, memory.results);
    return outcome;
}

ZoneResult GroupStep::solve_elastic(int cloth, ZoneMemory& memory) const {
    Zone& zone = new_zone(memory, m_state.node_position[m_model.cloths[cloth].first_node]);
    zone.contacts_off = true;
    add_cloth(zone, cloth, m_setting, m_state, m_control);
    ZoneOptions options = zone_options();
    options.full_steps = m_options.newton_iterations;
    return solve_zone(zone, PassiveBodies(), options, memory.workspace, memory.swept);
}

ZoneOptions GroupStep::zone_options() const {
    return {m_options.tolerance, m_options.max_iterations, std::nullopt, m_interrupt, m_options.is_substep};
}

/// The memory's zone, empty.
Zone& GroupStep::new_zone(ZoneMemory& memory, const Vec3& origin) const {
    return make_zone(memory.zone, m_model, m_parameters.cloths, m_options.compliance, origin);
}

/// Let a group's objects join its zone.
void GroupStep::join(
    const ObjectGroup& group, const std::vector<int>& members, const Objects& objects, Zone& zone) const {
    for (int k = group.first; k < group.end; ++k) {  // sorted: bodies come before cloths
        if (m_model.is_cloth(members[k])) {
            add_cloth(zone, members[k] - m_model.body_count(), m_setting, m_state, m_control);
            continue;
        }
        zone.bodies.push_back(objects.bodies[members[k]]);
        zone.bodies.back().start.t -= zone.origin;
    }
    zone.dynamic_count = zone.body_count();
    if (has_friction(group, members)) zone.friction = &m_parameters.friction;
    if (!m_options.split) return;
    zone.elastic = false;
    for (const ZoneCloth& cloth : zone.cloths)
        for (int k = 0; k < m_model.cloths[cloth.id].node_count(); ++k)
            zone.nodes[cloth.first_node + k].target = objects.elastic_shift[m_model.cloths[cloth.id].first_node + k];
}

bool GroupStep::has_friction(const ObjectGroup& group, const std::vector<int>& members) const {
    if (m_parameters.friction.empty()) return false;
    const auto rubs = [&](int object) { return m_parameters.friction[static_cast<std::size_t>(object)] > 0.0; };
    return std::any_of(members.begin() + group.first, members.begin() + group.end, rubs);
}

void GroupStep::write_motion(
    const ObjectGroup& group, const std::vector<int>& members, const ZoneMemory& memory, const Objects& objects) const {
    const Zone& zone = memory.zone;
    const ZonePoint& point = memory.workspace.point;
    for (int k = group.first; k < group.end; ++k) {
        const int i = members[k];
        Box& swept = objects.swept[i];
        swept = memory.swept[k - group.first];
        swept.inflate(m_model.margin(i));
        swept.lower += zone.origin;
        swept.upper += zone.origin;
        if (!m_model.is_cloth(i)) objects.y.bodies[i] = point.y.bodies[k - group.first];
    }
    for (const ZoneCloth& cloth : zone.cloths)
        for (int k = 0; k < m_model.cloths[cloth.id].node_count(); ++k)
            objects.y.nodes[m_model.cloths[cloth.id].first_node + k] = point.y.nodes[cloth.first_node + k];
}

void GroupStep::refuse_start(const ZoneContact& contact, double distance) const {
    const int a = contact.contact.object_a, b = contact.contact.object_b;
    throw PenetratingStart(
        "state: '" + m_model.name(a) + "' and '" + m_model.name(b) + "' penetrate: their meshes are " +
            number_text(distance) + " m apart, where at rest they keep " + number_text(contact.law.range.rest) +
            " m; move them apart, for instance with sim.separate(state)",
        a, b);
}

}  // namespace diffsim
