#include "contact/separation.hpp"

#include <Eigen/Geometry>
#include <algorithm>

namespace diffsim {
namespace {

constexpr int kMaxRounds = 100;
constexpr double kClearance = 1e-3;      // of the contact's depth: what to aim at beyond the rest distance
constexpr double kAccepted = 1e-9;       // of the contact's depth: how far below the rest distance is good enough
constexpr double kWellDefined = 0.02;    // of the contact's depth: nearer than this a normal may be rounding noise
constexpr int kRoundsBeforeGuesses = 3;  // before pairs without a normal of their own get one

/// Signed gap between two features and the direction in which it opens.
struct SignedGap {
    bool valid = false;
    double gap = 0.0;
    Vec3 normal = Vec3::Zero();
};

/// Outward direction of a feature, zero on open surfaces.
Vec3 outward(const CollisionMesh& mesh, const Pose& pose, int feature, bool is_patch) {
    if (!mesh.closed) return Vec3::Zero();
    return pose.R * (is_patch ? mesh.patches[feature].normal : mesh.edges[feature].outward);
}

SignedGap signed_gap(const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, bool guess) {
    SignedGap result;
    const double depth = contact.range.rest - contact.range.floor;
    if (contact.contact.with_ground() || geometry.distance > kWellDefined * depth)
        return {true, geometry.distance, geometry.normal};
    const Contact& c = contact.contact;
    const ClosestPoints& closest = geometry.closest;
    const Pose &pose_a = zone.bodies[contact.a].start, &pose_b = zone.bodies[contact.b].start;
    const CollisionMesh &mesh_a = zone.mesh(contact.a), &mesh_b = zone.mesh(contact.b);
    const Vec3 offset = closest.point_a - closest.point_b;
    if (c.type == ContactType::edge_edge) {
        if (closest.slide_count_a == 1 && closest.slide_count_b == 1 && geometry.sine_sq >= kParallelLimit) {
            result.normal = closest.slide_a[0].cross(closest.slide_b[0]).normalized();
            const Vec3 open = outward(mesh_b, pose_b, c.feature_b, false) - outward(mesh_a, pose_a, c.feature_a, false);
            if (result.normal.dot(open) < 0.0) result.normal = -result.normal;
            result.valid = !open.isZero(0.0);
        }
    } else if (c.type == ContactType::vertex_patch && closest.slide_count_b == 2) {
        result.normal = pose_b.R * mesh_b.patches[c.feature_b].normal;
        result.valid = true;
    } else if (c.type == ContactType::patch_vertex && closest.slide_count_a == 2) {
        result.normal = -(pose_a.R * mesh_a.patches[c.feature_a].normal);
        result.valid = true;
    }
    if (!result.valid && guess && geometry.sine_sq >= kParallelLimit) {
        // Corner against corner: any direction that leads apart will do.
        result.normal = (pose_a.t - pose_b.t).normalized();
        result.valid = result.normal.allFinite();
    }
    result.gap = result.normal.dot(offset);
    return result;
}

}  // namespace

Separation separate(Zone zone, const PassiveBodies& passive) {
    const std::size_t count = static_cast<std::size_t>(zone.dynamic_count);
    std::vector<Mat3> inertia_body(count);
    for (std::size_t i = 0; i < count; ++i)
        inertia_body[i] = zone.bodies[i].start.R.transpose() * zone.bodies[i].inertia * zone.bodies[i].start.R;
    const std::vector<double> mass_factor(count, 1.0);
    Separation result;
    ZonePoint point;
    BlockSystem system;
    for (int round = 0; round < kMaxRounds; ++round) {
        zone.bodies.resize(count);
        Coordinates begin(count, Vec6::Zero()), end(count, Vec6::Zero());
        for (ZoneBody& body : zone.bodies) body.target.setZero();
        collect_contacts(zone, passive, begin, end);
        std::vector<ImpactRow> rows;
        bool complete = true;
        for (const ZoneContact& contact : zone.contacts) {
            const bool ground = contact.contact.with_ground();
            const Pose& pose_a = zone.bodies[contact.a].start;
            const Pose& pose_b = ground ? pose_a : zone.bodies[contact.b].start;
            const ContactGeometry geometry =
                contact_geometry(*zone.model, contact.contact, pose_a, pose_b, zone.ground_height);
            const double depth = contact.range.rest - contact.range.floor;
            if (!(geometry.distance < contact.range.rest - kAccepted * depth) || geometry.sine_sq == 0.0) continue;
            complete = false;
            const SignedGap gap = signed_gap(zone, contact, geometry, round >= kRoundsBeforeGuesses);
            if (!gap.valid) continue;
            ContactGeometry oriented = geometry;
            oriented.normal = gap.normal;
            const Vec12 row = distance_gradient(oriented, pose_a.t, pose_b.t);
            ImpactRow entry;
            entry.a = contact.a < zone.dynamic_count ? contact.a : -1;
            entry.b = !ground && contact.b < zone.dynamic_count ? contact.b : -1;
            entry.pair = contact.pair;
            entry.row_a = row.head<6>();
            entry.row_b = row.tail<6>();
            entry.missing = contact.range.rest + kClearance * depth - gap.gap;
            entry.stiffness = contact.stiffness.value;
            rows.push_back(entry);
        }
        result.complete = complete;
        if (complete) break;
        system.set_pattern(zone.dynamic_count, zone.pairs);
        Coordinates p(count, Vec6::Zero());
        solve_impact_qp(zone, Coordinates(count, Vec6::Zero()), mass_factor, rows, system, p);
        for (std::size_t i = 0; i < count; ++i) {
            ZoneBody& body = zone.bodies[i];
            body.start = pose_at(body, p[i]);
            body.inertia = body.start.R * inertia_body[i] * body.start.R.transpose();
        }
    }
    for (std::size_t i = 0; i < count; ++i) result.poses.push_back(zone.bodies[i].start);
    return result;
}

}  // namespace diffsim
