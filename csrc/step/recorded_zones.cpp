#include "step/recorded_zones.hpp"

#include <algorithm>

#include "math/rotation.hpp"
#include "step/body_step.hpp"
#include "step/cloth_step.hpp"
#include "zone/contact_memory.hpp"
#include "zone/zone_contacts.hpp"

namespace diffsim {

namespace {

/// The two bodies of a pair, the smaller index first.
std::pair<int, int> bodies_of(const ObjectPair& pair) {
    return {std::min(pair.a.body, pair.b.body), std::max(pair.a.body, pair.b.body)};
}

/// Give each two bodies that yield and touch a block of the Hessian.
void number_blocks(Zone& zone) {
    ContactSet& set = zone.contacts;
    const auto has_block = [&](const ObjectPair& pair) { return zone.yields(pair.a.body) && zone.yields(pair.b.body); };
    for (const ObjectPair& pair : set.pairs)
        if (has_block(pair)) set.blocks.push_back(bodies_of(pair));
    std::sort(set.blocks.begin(), set.blocks.end());
    set.blocks.erase(std::unique(set.blocks.begin(), set.blocks.end()), set.blocks.end());
    for (ObjectPair& pair : set.pairs) {
        if (!has_block(pair)) continue;
        const auto block = std::lower_bound(set.blocks.begin(), set.blocks.end(), bodies_of(pair));
        pair.block = static_cast<int>(block - set.blocks.begin());
    }
}

}  // namespace

RecordedZones::Range RecordedZones::end_of(int index) const {
    if (index < 0) return {};
    const TouchingZones& zones = m_record.zones;
    return {zones.body_end[index], zones.cloth_end[index], zones.contact_end[index]};
}

void RecordedZones::rebuild(int index, ZoneMemory& memory, std::vector<int>& local) const {
    const Range first = end_of(index - 1), end = end_of(index);
    local.resize(m_model.bodies.size() + m_model.cloths.size(), -1);
    add_objects(first, end, memory, local);
    list_contacts(first, end, memory, local);
    Zone& zone = memory.zone;
    for (const ZoneBody& body : zone.bodies) local[body.id] = -1;
    for (const ZoneCloth& cloth : zone.cloths) local[m_model.body_count() + cloth.id] = -1;
    ZonePoint& point = memory.workspace.point;
    evaluate(zone, point);
    bool below_floor = false;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k)
        below_floor = below_floor || point.distances[k] < zone.contacts.law(k).range.floor;
    if (below_floor) {
        rescue_contacts(zone);
        evaluate(zone, point);
    }
    std::vector<ContactFriction>& friction = memory.workspace.friction;
    friction.clear();
    if (zone.friction == nullptr) return;
    for (const ActiveContact& active : point.active)
        friction.push_back(m_record.zones.friction[static_cast<std::size_t>(first.contact + active.index)]);
}

/// The bodies and cloths that yield.
void RecordedZones::add_objects(
    const Range& first, const Range& end, ZoneMemory& memory, std::vector<int>& local) const {
    Zone& zone = memory.zone;
    const Vec3 origin =
        first.body < end.body
            ? m_record.start.bodies[m_record.zones.bodies[first.body]].position
            : m_record.start.node_position[m_model.cloths[m_record.zones.cloths[first.cloth]].first_node];
    make_zone(zone, m_model, m_parameters.cloths, m_options.compliance, origin);
    zone.elastic = !m_options.split;
    if (!m_parameters.friction.empty()) zone.friction = &m_parameters.friction;
    memory.workspace.point.y.resize(0, 0);
    for (int b = first.body; b < end.body; ++b) join_body(memory, local, m_record.zones.bodies[b]);
    zone.dynamic_count = end.body - first.body;
    for (int c = first.cloth; c < end.cloth; ++c) join_cloth(memory, local, m_record.zones.cloths[c]);
}

void RecordedZones::join_body(ZoneMemory& memory, std::vector<int>& local, int id) const {
    const BodyState& state = m_record.start.bodies[id];
    ZoneBody body;
    body.id = id;
    if (m_model.bodies[id].is_dynamic()) {
        body = moving_body(m_setting, id, state, m_control.bodies[id], m_record.free_rotation[id]);
    } else {
        body.start = {quaternion_to_matrix(state.orientation), state.position};
        body.target = m_record.y.bodies[id];
    }
    body.start.t -= memory.zone.origin;
    local[id] = static_cast<int>(memory.zone.bodies.size());
    memory.zone.bodies.push_back(body);
    memory.workspace.point.y.bodies.push_back(m_record.y.bodies[id]);
}

void RecordedZones::join_cloth(ZoneMemory& memory, std::vector<int>& local, int id) const {
    const Cloth& cloth = m_model.cloths[id];
    Zone& zone = memory.zone;
    local[m_model.body_count() + id] = static_cast<int>(zone.cloths.size());
    add_cloth(zone, id, m_setting, m_record.start, m_control);
    const int first = zone.cloths.back().first_node;
    for (int k = 0; k < cloth.node_count(); ++k) {
        memory.workspace.point.y.nodes.push_back(m_record.y.nodes[cloth.first_node + k]);
        if (m_options.split) zone.nodes[first + k].target = m_record.elastic_shift[cloth.first_node + k];
    }
}

void RecordedZones::list_contacts(
    const Range& first, const Range& end, ZoneMemory& memory, std::vector<int>& local) const {
    Zone& zone = memory.zone;
    for (int c = first.contact; c < end.contact; ++c) {
        const Contact& contact = m_record.zones.contacts[c];
        for (int object : {contact.object_a, contact.object_b})
            if (object >= 0 && local[object] < 0) join_body(memory, local, object);  // one that does not yield
    }
    const auto object_of = [&](int object) {
        if (object == kGround) return ZoneObject{kGround, -1};
        return m_model.is_cloth(object) ? ZoneObject{kNobody, local[object]} : ZoneObject{local[object], -1};
    };
    for (int c = first.contact; c < end.contact; ++c) {
        const Contact& contact = m_record.zones.contacts[c];
        if (zone.exact_contact) zone.contacts.memory.compliance = m_record.zones.exact[c].compliance;
        add_contact(zone, contact, object_of(contact.object_a), object_of(contact.object_b));
        if (!zone.exact_contact) continue;
        ContactLaw& law = zone.contacts.laws.back();
        law.shift = m_record.zones.exact[c].shift;
        law.range.rest += law.shift;
    }
    number_blocks(zone);
}

std::vector<LinearisedZone> linearised_zones(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record) {
    const RecordedZones zones(model, options, parameters, control, record);
    ZoneMemory memory;
    std::vector<int> local;
    std::vector<LinearisedZone> result;
    for (int k = 0; k < zones.count(); ++k) {
        zones.rebuild(k, memory, local);
        result.push_back(linearise(memory.zone, memory.workspace.point));
    }
    return result;
}

}  // namespace diffsim
