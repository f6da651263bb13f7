#include "solve/separation.hpp"

#include <Eigen/Geometry>
#include <algorithm>

#include "solve/contact_model.hpp"

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
    const double depth = contact.law.range.rest - contact.law.range.floor;
    if (contact.contact.with_ground() || geometry.distance > kWellDefined * depth)
        return {true, geometry.distance, geometry.normal};
    const Contact& c = contact.contact;
    const ClosestPoints& closest = geometry.closest;
    if (contact.cloth_a >= 0 || contact.cloth_b >= 0) {
        // Cloth has no inside: where it is too near to tell the side, only a body's face can.
        if (contact.cloth_a >= 0 || c.type != ContactType::patch_vertex || closest.slide_count_a != 2) return result;
        const Vec3 normal = -outward(zone.mesh(contact.a), zone.bodies[contact.a].start, c.feature_a, true);
        return {!normal.isZero(0.0), normal.dot(closest.point_a - closest.point_b), normal};
    }
    const Pose &pose_a = zone.bodies[contact.a].start, &pose_b = zone.bodies[contact.b].start;
    const CollisionMesh &mesh_a = zone.mesh(contact.a), &mesh_b = zone.mesh(contact.b);
    const Vec3 offset = closest.point_a - closest.point_b;
    if (c.type == ContactType::edge_edge) {
        if (closest.slide_count_a == 1 && closest.slide_count_b == 1 && geometry.sine_sq >= kParallelLimit) {
            result.normal = closest.edge_a.cross(closest.edge_b).normalized();
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
    const std::size_t count = static_cast<std::size_t>(zone.dynamic_count), node_count = zone.nodes.size();
    std::vector<Mat3> inertia_body(count);
    for (std::size_t i = 0; i < count; ++i)
        inertia_body[i] = zone.bodies[i].start.R.transpose() * zone.bodies[i].inertia * zone.bodies[i].start.R;
    Separation result;
    ZonePoint point;
    BlockSystem system;
    ContactModel model;
    ModelWorkspace workspace;
    ContactCoverage coverage;
    Coordinates zero;
    zero.assign_zero(count, node_count);
    for (ZoneBody& body : zone.bodies) body.target.setZero();
    for (ZoneNode& node : zone.nodes) node.target.setZero();
    zone.elastic = false;  // it takes too little to strain anything
    for (int round = 0; round < kMaxRounds; ++round) {
        zone.bodies.resize(count);
        Coordinates begin = zero, end = zero;
        collect_contacts(zone, passive, begin, end, coverage);
        Placement at;
        at.y = begin;
        place(zone, at.y, at.poses, at.nodes);
        model.rows.clear();
        std::vector<int> row_contacts;
        bool complete = true;
        result.lack = 0.0;
        for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
            const ZoneContact& contact = zone.contacts[k];
            ContactGeometry geometry = contact_geometry(zone, contact, at.poses, at.nodes);
            const double depth = contact.law.range.rest - contact.law.range.floor;
            if (!(geometry.distance < contact.law.range.rest - kAccepted * depth) || geometry.sine_sq == 0.0) continue;
            complete = false;
            const double lack = (contact.law.range.rest - geometry.distance) / depth;
            if (lack > result.lack) {
                result.worst = contact.contact;
                result.distance = geometry.distance;
                result.rest = contact.law.range.rest;
                result.lack = lack;
            }
            const SignedGap gap = signed_gap(zone, contact, geometry, round >= kRoundsBeforeGuesses);
            if (!gap.valid) continue;
            geometry.normal = gap.normal;
            geometry.distance = gap.gap;
            model.rows.push_back(
                make_row(zone, contact, geometry, at, begin, contact.law.range.rest + kClearance * depth));
            model.rows.back().range = depth;
            row_contacts.push_back(static_cast<int>(k));
        }
        result.complete = complete;
        if (complete) break;
        system.set_pattern(base_pattern(zone));
        ensure_pattern(zone, row_contacts, system);
        model.smooth.set_pattern(system.pattern());
        model.smooth.set_zero();
        // Moving apart is geometry: however different their masses, bodies share the way.
        for (int i = 0; i < zone.dynamic_count; ++i) {
            model.smooth.diagonal(i).topLeftCorner<3, 3>() = zone.bodies[i].inertia / zone.bodies[i].mass;
            model.smooth.diagonal(i).diagonal().tail<3>().setOnes();
        }
        for (int i = 0; i < zone.node_count(); ++i)
            model.smooth.node_diagonal(i) = (zone.nodes[i].pinned ? 1.0 : zone.nodes[i].mass) * Mat3::Identity();
        model.gradient = zero;
        Coordinates p = zero;
        minimise(model, 1.0, 0.0, system, workspace, p);
        for (std::size_t i = 0; i < count; ++i) {
            ZoneBody& body = zone.bodies[i];
            body.start = pose_at(body, p.bodies[i]);
            body.inertia = body.start.R * inertia_body[i] * body.start.R.transpose();
        }
        for (std::size_t i = 0; i < node_count; ++i) zone.nodes[i].start += p.nodes[i];
    }
    for (std::size_t i = 0; i < count; ++i) result.poses.push_back(zone.bodies[i].start);
    for (const ZoneNode& node : zone.nodes) result.nodes.push_back(node.start);
    return result;
}

}  // namespace diffsim
