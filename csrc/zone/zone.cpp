#include "zone/zone.hpp"

#include <type_traits>

#include "math/rotation.hpp"
#include "zone/contact_memory.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {

Pose pose_at(const ZoneBody& body, const Vec6& y) {
    if (y.isZero(0.0)) return body.start;
    return {exp_rotation(y.head<3>()) * body.start.R, body.start.t + y.tail<3>()};
}

Zone& make_zone(
    Zone& zone, const Model& model, const std::vector<ClothParameters>& cloths, double compliance, const Vec3& origin) {
    zone.nodes.clear();
    zone.cloths.clear();
    zone.dynamic_count = 0;
    zone.model = &model;
    zone.cloth_parameters = &cloths;
    zone.friction = nullptr;
    zone.exact_contact = compliance == 0.0;
    zone.compliance = zone.exact_contact ? kDefaultCompliance : compliance;
    forget_contacts(zone);
    zone.origin = origin;
    zone.ground_height = model.ground.height - origin.z();
    zone.elastic = true;
    zone.contacts_off = false;
    return zone;
}

namespace {

/// Have the vertices of a body's feature placed with the zone.
void list_vertices(Zone& zone, int body, const Feature& feature) {
    FeatureVertices& vertices = zone.contacts.vertices;
    while (static_cast<int>(vertices.first.size()) <= body) {
        const std::size_t first = vertices.listed.size();
        const std::size_t count = zone.mesh(static_cast<int>(vertices.first.size())).vertices.size();
        vertices.first.push_back(static_cast<int>(first));
        vertices.listed.resize(first + count, 0);
    }
    const auto list = [&](int vertex) {
        char& listed = vertices.listed[static_cast<std::size_t>(vertices.first[body] + vertex)];
        if (!listed) vertices.entries.push_back({body, vertex});
        listed = 1;
    };
    const CollisionMesh& mesh = zone.mesh(body);
    if (feature.kind == FeatureKind::patch) {
        for (int vertex : mesh.patches[feature.index].vertices) list(vertex);
        return;
    }
    for (int vertex : feature_vertices(mesh, feature))
        if (vertex >= 0) list(vertex);
}

}  // namespace

void list_feature_vertices(Zone& zone, const ZoneContact& contact) {
    if (contact.contact.with_ground()) return;
    const auto list = [&](const auto& side) {
        if constexpr (std::is_same_v<decltype(side), const SideOfBody&>)
            list_vertices(zone, side.body(), side.feature());
    };
    with_sides(zone, contact, [&](const auto& a, const auto& b) {
        list(a);
        list(b);
    });
}

}  // namespace diffsim
