#pragma once

#include <utility>

#include "contact/sides.hpp"
#include "zone/zone_point.hpp"

/// The one place that decodes what the sides of a zone's contacts are: a body, a cloth or the
/// ground, and whether they yield.
namespace diffsim {

/// Call visit(a, b) with the two sides of a contact, each a SideOfBody or a SideOfCloth, b maybe a
/// SideOfGround. A body comes before a cloth.
template <class Visit>
decltype(auto) with_sides(const Zone& zone, const ZoneContact& contact, Visit&& visit);

class SideOfBody {
public:
    SideOfBody(const Zone& zone, int body, const Feature& feature) : m_zone(zone), m_body(body), m_feature(feature) {}

    int body() const { return m_body; }  ///< index into Zone::bodies
    const Feature& feature() const { return m_feature; }
    const CollisionMesh& mesh() const { return m_zone.mesh(m_body); }
    bool yields() const { return m_zone.yields(m_body); }
    double mass() const { return m_zone.bodies[m_body].mass / m_zone.bodies[m_body].weight; }
    Surface surface(const std::vector<Pose>& poses, const std::vector<Vec3>&) const {
        return {&mesh(), &poses[m_body], nullptr};
    }
    /// With its vertices placed. Not for contacts with the ground.
    Surface surface(const ZonePoint& point) const {
        return {&mesh(), &point.poses[m_body], point.vertices.data() + m_zone.contacts.vertices.first[m_body]};
    }
    /// Call visit_body(body) or visit_node(node) with everything that moves it.
    template <class VisitBody, class VisitNode>
    void visit_movers(const VisitBody& visit_body, const VisitNode&) const {
        visit_body(m_body);
    }

private:
    const Zone& m_zone;
    int m_body;
    Feature m_feature;
};

class SideOfCloth {
public:
    SideOfCloth(const Zone& zone, int cloth, const Feature& feature)
        : m_zone(zone), m_cloth(cloth), m_feature(feature) {}

    int cloth() const { return m_cloth; }  ///< index into Zone::cloths
    const Feature& feature() const { return m_feature; }
    /// The nodes of the zone that its feature has; -1 fills the rest.
    std::array<int, 3> nodes() const {
        std::array<int, 3> nodes = feature_vertices(m_zone.cloth(m_cloth).surface, m_feature);
        for (int& node : nodes)
            if (node >= 0) node += m_zone.cloths[m_cloth].first_node;
        return nodes;
    }
    /// Sum of its nodes' own masses.
    double mass() const {
        double mass = 0.0;
        for (int node : nodes())
            if (node >= 0) mass += m_zone.nodes[node].mass / m_zone.nodes[node].weight;
        return mass;
    }
    Surface surface(const std::vector<Pose>&, const std::vector<Vec3>& nodes) const {
        return {&m_zone.cloth(m_cloth).surface, nullptr, nodes.data() + m_zone.cloths[m_cloth].first_node};
    }
    Surface surface(const ZonePoint& point) const { return surface(point.poses, point.nodes); }
    template <class VisitBody, class VisitNode>
    void visit_movers(const VisitBody&, const VisitNode& visit_node) const {
        for (int node : nodes())
            if (node >= 0) visit_node(node);
    }

private:
    const Zone& m_zone;
    int m_cloth;
    Feature m_feature;
};

class SideOfGround {
public:
    static double mass() { return kInfinity; }
    static Surface surface(const std::vector<Pose>&, const std::vector<Vec3>&) { return {}; }
    static Surface surface(const ZonePoint&) { return {}; }
    template <class VisitBody, class VisitNode>
    static void visit_movers(const VisitBody&, const VisitNode&) {}
};

template <class Visit>
decltype(auto) with_sides(const Zone& zone, const ZoneContact& contact, Visit&& visit) {
    const Contact& c = contact.contact;
    if (contact.cloth_a >= 0) {
        const SideOfCloth a(zone, contact.cloth_a, c.on_a());
        if (c.with_ground()) return visit(a, SideOfGround());
        return visit(a, SideOfCloth(zone, contact.cloth_b, c.on_b()));
    }
    const SideOfBody a(zone, contact.a, c.on_a());
    if (c.with_ground()) return visit(a, SideOfGround());
    if (contact.cloth_b >= 0) return visit(a, SideOfCloth(zone, contact.cloth_b, c.on_b()));
    return visit(a, SideOfBody(zone, contact.b, c.on_b()));
}

/// Call visit_body(body) or visit_node(node) with everything that moves a contact, whether it yields or not.
template <class VisitBody, class VisitNode>
void visit_movers(
    const Zone& zone, const ZoneContact& contact, const VisitBody& visit_body, const VisitNode& visit_node) {
    with_sides(zone, contact, [&](const auto& a, const auto& b) {
        a.visit_movers(visit_body, visit_node);
        b.visit_movers(visit_body, visit_node);
    });
}

/// Whether all that moves a contact are bodies that yield.
inline bool is_of_yielding_bodies(const Zone& zone, const ZoneContact& contact) {
    bool result = true;
    visit_movers(zone, contact, [&](int body) { result = result && zone.yields(body); }, [&](int) { result = false; });
    return result;
}

// --- sides along whose coordinates derivatives are taken

template <class Side>
struct PlacedSide;

template <>
struct PlacedSide<BodySide> {
    int body;  ///< index into Zone::bodies
    bool yields;
    BodySide side;
};

template <>
struct PlacedSide<ClothSide> {
    std::array<int, 3> nodes;  ///< of the zone; -1 fills the rest
    ClothSide side;
};

template <>
struct PlacedSide<GroundSide> {};

inline PlacedSide<BodySide> placed_side(
    const SideOfBody& side, const ClosestPoint&, const Vec3&, const std::vector<Pose>& poses,
    const std::vector<Vec3>&) {
    return {side.body(), side.yields(), {poses[side.body()].t}};
}
inline PlacedSide<ClothSide> placed_side(
    const SideOfCloth& side, const ClosestPoint& closest, const Vec3& normal, const std::vector<Pose>& poses,
    const std::vector<Vec3>& nodes) {
    return {side.nodes(), cloth_side(closest, normal, side.feature(), side.surface(poses, nodes))};
}
inline PlacedSide<GroundSide> placed_side(
    const SideOfGround&, const ClosestPoint&, const Vec3&, const std::vector<Pose>&, const std::vector<Vec3>&) {
    return {};
}

/// Call visit(a, b) with the sides of a contact where bodies and nodes are at these places.
template <class Visit>
decltype(auto) with_placed_sides(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const std::vector<Pose>& poses,
    const std::vector<Vec3>& nodes, Visit&& visit) {
    return with_sides(zone, contact, [&](const auto& a, const auto& b) -> decltype(auto) {
        return visit(
            placed_side(a, geometry.closest.a, geometry.normal, poses, nodes),
            placed_side(b, geometry.closest.b, geometry.normal, poses, nodes));
    });
}

}  // namespace diffsim
