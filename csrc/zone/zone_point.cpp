#include "zone/zone_point.hpp"

#include "zone/contacts.hpp"
#include "zone/elasticity.hpp"
#include "zone/inertia.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {

ContactGeometry contact_geometry(
    const Zone& zone, const ZoneContact& contact, const std::vector<Pose>& poses, const std::vector<Vec3>& nodes) {
    return with_sides(zone, contact, [&](const auto& a, const auto& b) -> ContactGeometry {
        return {contact.contact, a.surface(poses, nodes), b.surface(poses, nodes), zone.ground_height};
    });
}

void place(const Zone& zone, const Coordinates& y, std::vector<Pose>& poses, std::vector<Vec3>& nodes) {
    poses.resize(zone.bodies.size());
    for (std::size_t i = 0; i < zone.bodies.size(); ++i) poses[i] = pose_at(zone.bodies[i], y.bodies[i]);
    nodes.resize(zone.nodes.size());
    for (std::size_t i = 0; i < zone.nodes.size(); ++i) nodes[i] = zone.nodes[i].start + y.nodes[i];
}

namespace {

void place_vertices(const Zone& zone, ZonePoint& point) {
    const FeatureVertices& vertices = zone.contacts.vertices;
    point.vertices.resize(vertices.listed.size());
    for (const auto& [body, vertex] : vertices.entries)
        point.vertices[vertices.first[body] + vertex] = point.poses[body] * zone.mesh(body).vertices[vertex];
}

}  // namespace

void evaluate(const Zone& zone, ZonePoint& point, const ZonePoint* before) {
    place(zone, point.y, point.poses, point.nodes);
    place_vertices(zone, point);
    const double inertial = inertial_energy(zone, point.y);
    point.elastic_energy = elastic_energy(zone, point.nodes);
    evaluate_contacts(zone, point, before);
    point.energy = inertial + point.elastic_energy + point.contact_energy;
}

}  // namespace diffsim
