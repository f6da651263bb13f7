#include "step/contact_readout.hpp"

#include "step/recorded_zones.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

/// d(log stiffness)/d(log mass) of an object.
double mass_exponent(const Zone& zone, const SideOfBody& side, double log_gradient) {
    return log_gradient * (side.yields() ? zone.bodies[side.body()].mass : 0.0);
}
double mass_exponent(const Zone&, const SideOfCloth& side, double log_gradient) { return log_gradient * side.mass(); }

void read_nodes(
    const Zone&, const ZonePoint&, const ClosestPoint&, const Vec3&, const SideOfBody&, ContactReadout::Side&) {}
void read_nodes(
    const Zone& zone, const ZonePoint& point, const ClosestPoint& closest, const Vec3& normal, const SideOfCloth& side,
    ContactReadout::Side& result) {
    const PlacedSide<ClothSide> placed = placed_side(side, closest, normal, point.poses, point.nodes);
    result.weights = placed.side.weights;
    result.slide_weights = placed.side.slide;
    const int to_model = zone.cloth(side.cloth()).first_node - zone.cloths[side.cloth()].first_node;
    for (std::size_t k = 0; k < 3; ++k) result.nodes[k] = placed.nodes[k] < 0 ? -1 : placed.nodes[k] + to_model;
}

template <class Side>
ContactReadout::Side read_side(
    const Zone& zone, const ZonePoint& point, const ClosestPoint& closest, const Vec3& normal, const Side& side,
    int object, double log_gradient) {
    ContactReadout::Side result;
    result.object = object;
    result.point = closest.point + zone.origin;
    result.slide_count = closest.slide_count;
    result.slides = slide_directions(closest, normal);
    result.mass_exponent = mass_exponent(zone, side, log_gradient);
    read_nodes(zone, point, closest, normal, side, result);
    return result;
}

/// A plane: slides are what is level.
ContactReadout::Side read_side(
    const Zone& zone, const ZonePoint&, const ClosestPoint& closest, const Vec3&, const SideOfGround&, int, double) {
    ContactReadout::Side result;
    result.point = closest.point + zone.origin;
    result.slide_count = 2;
    result.slides = {Vec3::UnitX(), Vec3::UnitY()};
    return result;
}

/// `friction`: null in a zone without.
ContactReadout read_contact(
    const Zone& zone, const ZonePoint& point, const ActiveContact& active, const ContactFriction* friction, double dt) {
    const ZoneContact& contact = zone.contacts[active.index];
    const ContactGeometry& geometry = active.geometry;
    const PotentialValue potential = normal_force(contact.law, geometry.distance);
    const double share = edge_mollifier(geometry.sine_sq).value / (dt * dt);
    ContactReadout result;
    const ContactStiffness& stiffness = contact.law.stiffness;
    const Vec3& n = geometry.normal;
    with_sides(zone, contact, [&](const auto& a, const auto& b) {
        result.sides = {
            read_side(zone, point, geometry.closest.a, n, a, contact.contact.object_a, stiffness.log_gradient_a),
            read_side(zone, point, geometry.closest.b, n, b, contact.contact.object_b, stiffness.log_gradient_b)};
    });
    result.normal = n;
    result.distance = geometry.distance;
    result.sine_sq = geometry.sine_sq;
    if (contact.contact.type == ContactType::edge_edge) {
        result.sides[0].edge = geometry.closest.a.edge;
        result.sides[1].edge = geometry.closest.b.edge;
    }
    result.force = share * potential.force;
    result.stiffness = share * potential.stiffness;
    if (friction == nullptr || !(contact.law.friction > 0.0)) return result;
    result.friction = -contact.law.friction * result.force * (friction->share - n * n.dot(friction->share));
    result.sticks = !friction->slips;
    return result;
}

}  // namespace

std::vector<ContactReadout> read_contacts(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record) {
    const RecordedZones zones(model, options, parameters, control, record);
    ZoneMemory memory;
    std::vector<int> local;
    std::vector<ContactReadout> result;
    for (int k = 0; k < zones.count(); ++k) {
        zones.rebuild(k, memory, local);
        const ZonePoint& point = memory.workspace.point;
        const std::vector<ContactFriction>& friction = memory.workspace.friction;
        for (std::size_t i = 0; i < point.active.size(); ++i) {
            result.push_back(read_contact(
                memory.zone, point, point.active[i], friction.empty() ? nullptr : &friction[i], options.dt));
            if (result.back().force == 0.0) result.pop_back();  // parallel edges
        }
    }
    return result;
}

}  // namespace diffsim
