#include "contact/contact.hpp"

#include <Eigen/Geometry>
#include <array>
#include <cmath>

#include "collision/ccd.hpp"

namespace diffsim {
namespace {

/// Directions carry rounding of 1e-16: edges whose squared sine is no more than this are exactly parallel.
constexpr double kRoundedSineSq = 1e-30;

/// Positions of a patch's corners; on the stack for all but unusual patches.
class Corners {
public:
    Corners(const Surface& surface, int patch) {
        const std::vector<int>& loop = surface.mesh->patches[patch].vertices;
        m_count = static_cast<int>(loop.size());
        if (m_count > kSmall) m_large.resize(loop.size());
        Vec3* corners = m_count > kSmall ? m_large.data() : m_small.data();
        for (int k = 0; k < m_count; ++k) corners[k] = surface.vertex(loop[k]);
    }
    const Vec3* data() const { return m_count > kSmall ? m_large.data() : m_small.data(); }
    int count() const { return m_count; }

private:
    static constexpr int kSmall = 16;
    std::array<Vec3, kSmall> m_small;
    std::vector<Vec3> m_large;
    int m_count;
};

/// Positions of an edge's ends.
struct Ends {
    Vec3 x[2];

    Ends(const Surface& surface, int edge)
        : x{surface.vertex(surface.mesh->edges[edge].p0), surface.vertex(surface.mesh->edges[edge].p1)} {}
};

ClosestPoints swapped(const ClosestPoints& points) {
    ClosestPoints result = points;
    std::swap(result.a, result.b);
    return result;
}

/// A vertex of `v` against a patch of `p`.
ClosestPoints vertex_against_patch(const Surface& v, int vertex, const Surface& p, int patch) {
    const Corners corners(p, patch);
    const Vec3 normal = p.pose != nullptr ? Vec3(p.pose->R * p.mesh->patches[patch].normal)
                                          : polygon_normal(corners.data(), corners.count());
    return closest_vertex_polygon(v.vertex(vertex), {corners.data(), corners.count(), normal});
}

ClosestPoints vertex_above_ground(const Vec3& vertex, double ground_height) {
    ClosestPoints points;
    points.a.point = vertex;
    points.b.point = Vec3(vertex.x(), vertex.y(), ground_height);
    return points;
}

ClosestPoints closest_points(const Contact& contact, const Surface& a, const Surface& b, double ground_height) {
    if (contact.with_ground()) return vertex_above_ground(a.vertex(contact.feature_a), ground_height);
    switch (contact.type) {
        case ContactType::vertex_patch:
            return vertex_against_patch(a, contact.feature_a, b, contact.feature_b);
        case ContactType::patch_vertex:
            return swapped(vertex_against_patch(b, contact.feature_b, a, contact.feature_a));
        case ContactType::edge_edge:
            break;
    }
    const Ends ends_a(a, contact.feature_a), ends_b(b, contact.feature_b);
    return closest_edge_edge(ends_a.x[0], ends_a.x[1], ends_b.x[0], ends_b.x[1]);
}

}  // namespace

ContactGeometry::ContactGeometry(const Contact& contact, const Surface& a, const Surface& b, double ground_height)
    : closest(closest_points(contact, a, b, ground_height)) {
    if (contact.with_ground()) {
        distance = closest.a.point.z() - ground_height;
        normal = Vec3::UnitZ();
        return;
    }
    const Vec3 offset = closest.a.point - closest.b.point;
    distance = offset.norm();
    normal = distance > 0.0 ? Vec3((1.0 / distance) * offset) : Vec3(Vec3::Zero());
    if (contact.type == ContactType::edge_edge) {
        const Vec3 &da = closest.a.edge, &db = closest.b.edge;
        const double value = da.cross(db).squaredNorm() / (da.squaredNorm() * db.squaredNorm());
        sine_sq = value > kRoundedSineSq ? value : 0.0;
    }
}

ContactGeometry contact_geometry(
    const Model& model, const Contact& contact, const Pose& pose_a, const Pose& pose_b, double ground_height) {
    const Surface a{&model.bodies[contact.object_a].mesh, &pose_a, nullptr};
    const Surface b =
        contact.with_ground() ? Surface{} : Surface{&model.bodies[contact.object_b].mesh, &pose_b, nullptr};
    return {contact, a, b, ground_height};
}

double contact_toi(
    const Contact& contact, const SweptSurface& a, const SweptSurface& b, double ground_height,
    const CcdOptions& options) {
    if (contact.with_ground())
        return plane_toi(
            a.begin.vertex(contact.feature_a).z() - ground_height, a.end.vertex(contact.feature_a).z() - ground_height,
            options);
    if (contact.type == ContactType::edge_edge) {
        const Ends a0(a.begin, contact.feature_a), a1(a.end, contact.feature_a);
        const Ends b0(b.begin, contact.feature_b), b1(b.end, contact.feature_b);
        return edge_edge_ccd(a0.x, a1.x, b0.x, b1.x, options).toi;
    }
    const bool vertex_on_a = contact.type == ContactType::vertex_patch;
    const SweptSurface &v = vertex_on_a ? a : b, &p = vertex_on_a ? b : a;
    const int vertex = vertex_on_a ? contact.feature_a : contact.feature_b;
    const int patch = vertex_on_a ? contact.feature_b : contact.feature_a;
    const Corners begin(p.begin, patch), end(p.end, patch);
    return vertex_polygon_ccd(
               v.begin.vertex(vertex), v.end.vertex(vertex), begin.data(), end.data(), begin.count(), options)
        .toi;
}

std::array<int, 3> feature_vertices(const CollisionMesh& mesh, const Feature& feature) {
    switch (feature.kind) {
        case FeatureKind::vertex:
            return {feature.index, -1, -1};
        case FeatureKind::edge:
            return {mesh.edges[feature.index].p0, mesh.edges[feature.index].p1, -1};
        case FeatureKind::patch:
            break;
    }
    const std::vector<int>& loop = mesh.patches[feature.index].vertices;
    return {loop[0], loop[1], loop[2]};
}

}  // namespace diffsim
