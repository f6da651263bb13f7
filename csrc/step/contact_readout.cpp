#include "step/contact_readout.hpp"

#include "contact/contact_derivatives.hpp"
#include "step/recorded_zones.hpp"

namespace diffsim {
namespace {

double feature_mass(const Zone& zone, const ZoneContact& contact, bool of_a) {
    const int body = of_a ? contact.a : contact.b;
    if ((of_a ? contact.cloth_a : contact.cloth_b) < 0) return zone.yields(body) ? zone.bodies[body].mass : 0.0;
    double mass = 0.0;
    for (int node : feature_nodes(zone, contact, of_a))
        if (node >= 0) mass += zone.nodes[node].mass;
    return mass;
}

ContactReadout::Side read_side(
    const Zone& zone, const ZonePoint& point, const ZoneContact& contact, const ContactGeometry& geometry, bool of_a) {
    ContactReadout::Side side;
    side.object = of_a ? contact.contact.object_a : contact.contact.object_b;
    const ClosestPoints& closest = geometry.closest;
    side.point = (of_a ? closest.point_a : closest.point_b) + zone.origin;
    if (side.object == kGround) {  // a plane: slides are what is level
        side.slide_count = 2;
        side.slides = {Vec3::UnitX(), Vec3::UnitY()};
        return side;
    }
    side.slide_count = of_a ? closest.slide_count_a : closest.slide_count_b;
    side.slides = slide_directions(geometry, of_a);
    side.mass_exponent = (of_a ? contact.stiffness.log_gradient_a : contact.stiffness.log_gradient_b) *
                         feature_mass(zone, contact, of_a);
    const int cloth = of_a ? contact.cloth_a : contact.cloth_b;
    if (cloth < 0) return side;
    const Surface surface =
        of_a ? surface_a(zone, contact, point.poses, point.nodes) : surface_b(zone, contact, point.poses, point.nodes);
    const ClothSide weights = cloth_side(contact.contact, geometry, surface, of_a);
    side.weights = weights.weights;
    side.slide_weights = weights.slide;
    const std::array<int, 3> nodes = feature_nodes(zone, contact, of_a);
    const int to_model = zone.cloth(cloth).first_node - zone.cloths[cloth].first_node;
    for (std::size_t k = 0; k < 3; ++k) side.nodes[k] = nodes[k] < 0 ? -1 : nodes[k] + to_model;
    return side;
}

ContactReadout read_contact(const Zone& zone, const ZonePoint& point, const ActiveContact& active, double dt) {
    const ZoneContact& contact = zone.contacts[active.index];
    const ContactGeometry& geometry = active.geometry;
    const PotentialValue potential = contact_potential(
        contact.range.rest - geometry.distance, contact.range.rest - contact.range.pole, contact.stiffness.value);
    const double share = edge_mollifier(geometry.sine_sq).value / (dt * dt);
    ContactReadout result;
    result.sides = {read_side(zone, point, contact, geometry, true), read_side(zone, point, contact, geometry, false)};
    result.normal = geometry.normal;
    result.distance = geometry.distance;
    result.sine_sq = geometry.sine_sq;
    result.sine_sq = geometry.sine_sq;
    result.force = share * potential.force;
    result.stiffness = share * potential.stiffness;
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
        for (const ActiveContact& active : memory.workspace.point.active) {
            result.push_back(read_contact(memory.zone, memory.workspace.point, active, options.dt));
            if (result.back().force == 0.0) result.pop_back();  // parallel edges
        }
    }
    return result;
}

}  // namespace diffsim
