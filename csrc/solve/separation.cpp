#include "solve/separation.hpp"

#include <Eigen/Geometry>
#include <algorithm>

#include "solve/contact_model.hpp"
#include "zone/contacts.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

constexpr int kMaxMoves = 100;
constexpr int kMaxMoveListings = 8;      // for a move that leads to what it was found without
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

/// Outward direction of a body's feature, which is an edge or a patch; zero on open surfaces.
Vec3 outward(const Zone& zone, const SideOfBody& side) {
    const CollisionMesh& mesh = side.mesh();
    const int feature = side.feature().index;
    if (!mesh.closed) return Vec3::Zero();
    const bool is_patch = side.feature().kind == FeatureKind::patch;
    return zone.bodies[side.body()].start.R * (is_patch ? mesh.patches[feature].normal : mesh.edges[feature].outward);
}

/// Normal of a body's patch, whether the surface is closed or not.
Vec3 face_normal(const Zone& zone, const SideOfBody& side) {
    return zone.bodies[side.body()].start.R * side.mesh().patches[side.feature().index].normal;
}

SignedGap along(const ContactGeometry& geometry, const Vec3& normal, bool valid) {
    return {valid, normal.dot(geometry.closest.a.point - geometry.closest.b.point), normal};
}

// What opens a pair of features whose own normal is rounding noise.

SignedGap opening(
    const Zone& zone, const ContactGeometry& geometry, bool guess, const SideOfBody& a, const SideOfBody& b) {
    const ClosestPoint &on_a = geometry.closest.a, &on_b = geometry.closest.b;
    const bool parallel = geometry.sine_sq < kParallelLimit;
    SignedGap result;
    if (a.feature().kind == FeatureKind::edge) {
        if (on_a.slide_count == 1 && on_b.slide_count == 1 && !parallel) {
            result.normal = on_a.edge.cross(on_b.edge).normalized();
            const Vec3 open = outward(zone, b) - outward(zone, a);
            if (result.normal.dot(open) < 0.0) result.normal = -result.normal;
            result.valid = !open.isZero(0.0);
        }
    } else if (b.feature().kind == FeatureKind::patch && on_b.slide_count == 2) {
        result.normal = face_normal(zone, b);
        result.valid = true;
    } else if (a.feature().kind == FeatureKind::patch && on_a.slide_count == 2) {
        result.normal = -face_normal(zone, a);
        result.valid = true;
    }
    if (!result.valid && guess && !parallel) {
        // Corner against corner: any direction that leads apart will do.
        result.normal = (zone.bodies[a.body()].start.t - zone.bodies[b.body()].start.t).normalized();
        result.valid = result.normal.allFinite();
    }
    return along(geometry, result.normal, result.valid);
}

/// Cloth has no inside: where it is too near to tell the side, only a body's face can.
SignedGap opening(const Zone& zone, const ContactGeometry& geometry, bool, const SideOfBody& a, const SideOfCloth&) {
    if (a.feature().kind != FeatureKind::patch || geometry.closest.a.slide_count != 2) return {};
    const Vec3 normal = -outward(zone, a);
    return along(geometry, normal, !normal.isZero(0.0));
}

SignedGap opening(const Zone&, const ContactGeometry&, bool, const SideOfCloth&, const SideOfCloth&) { return {}; }

template <class A>
SignedGap opening(const Zone&, const ContactGeometry& geometry, bool, const A&, const SideOfGround&) {
    return {true, geometry.distance, geometry.normal};
}

SignedGap signed_gap(const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, bool guess) {
    const double depth = contact.law.range.rest - contact.law.range.floor;
    if (geometry.distance > kWellDefined * depth) return {true, geometry.distance, geometry.normal};
    return with_sides(
        zone, contact, [&](const auto& a, const auto& b) { return opening(zone, geometry, guess, a, b); });
}

/// Rounds of moving apart, each by one convex model of the contacts that are too near.
class Separator {
public:
    Separator(Zone& zone, const PassiveBodies& passive)
        : m_zone(zone), m_passive(passive), m_count(static_cast<std::size_t>(zone.dynamic_count)) {
        for (std::size_t i = 0; i < m_count; ++i) {
            const ZoneBody& body = zone.bodies[i];
            m_inertia_body.push_back(body.start.R.transpose() * body.inertia * body.start.R);
        }
        m_zero.assign_zero(m_count, zone.nodes.size());
        for (ZoneBody& body : zone.bodies) body.target.setZero();
        for (ZoneNode& node : zone.nodes) node.target.setZero();
        zone.elastic = false;  // it takes too little to strain anything
    }

    Separation run() {
        for (int round = 0; round < kMaxMoves; ++round) {
            const bool guess = round >= kRoundsBeforeGuesses;
            list_rows(m_zero, guess);
            if (m_result.complete) break;
            Coordinates move = find_move();
            for (int listings = 0; listings < kMaxMoveListings; ++listings) {
                const std::size_t known = m_model.rows.size();
                list_rows(move, guess);
                if (m_model.rows.size() == known) break;
                move = find_move();
            }
            apply(move);
        }
        for (std::size_t i = 0; i < m_count; ++i) m_result.poses.push_back(m_zone.bodies[i].start);
        for (const ZoneNode& node : m_zone.nodes) m_result.nodes.push_back(node.start);
        return m_result;
    }

private:
    /// One for each contact that a move may bring too near.
    void list_rows(Coordinates end, bool guess) {
        m_zone.bodies.resize(m_count);
        Coordinates begin = m_zero;
        collect_contacts(m_zone, m_passive, begin, end, m_coverage);
        Placement at;
        at.y = begin;
        place(m_zone, at.y, at.poses, at.nodes);
        m_model.rows.clear();
        m_row_contacts.clear();
        m_result.complete = true;
        m_result.lack = 0.0;
        for (std::size_t k = 0; k < m_zone.contacts.size(); ++k) {
            const ZoneContact& contact = m_zone.contacts[k];
            const ContactRange& range = contact.law.range;
            ContactGeometry geometry = contact_geometry(m_zone, contact, at.poses, at.nodes);
            const double depth = range.rest - range.floor;
            if (geometry.sine_sq == 0.0) continue;
            const double lack = (range.rest - geometry.distance) / depth;
            if (lack > kAccepted) {
                m_result.complete = false;
                if (lack > m_result.lack) {
                    m_result.worst = contact.contact;
                    m_result.distance = geometry.distance;
                    m_result.rest = range.rest;
                    m_result.lack = lack;
                }
            }
            const SignedGap gap = signed_gap(m_zone, contact, geometry, guess);
            if (!gap.valid) continue;
            geometry.normal = gap.normal;
            geometry.distance = gap.gap;
            m_model.rows.push_back(make_row(m_zone, contact, geometry, at, begin, range.rest + kClearance * depth));
            m_model.rows.back().range = depth;
            m_row_contacts.push_back(static_cast<int>(k));
        }
    }

    /// Moving apart is geometry: however different their masses, bodies share the way.
    void set_metric() {
        m_system.set_pattern(base_pattern(m_zone));
        ensure_pattern(m_zone, m_row_contacts, m_system);
        m_model.smooth.set_pattern(m_system.pattern());
        m_model.smooth.set_zero();
        for (int i = 0; i < m_zone.dynamic_count; ++i) {
            const ZoneBody& body = m_zone.bodies[i];
            m_model.smooth.diagonal(i).topLeftCorner<3, 3>() = body.inertia / body.mass;
            m_model.smooth.diagonal(i).diagonal().tail<3>().setOnes();
        }
        for (int i = 0; i < m_zone.node_count(); ++i) {
            const ZoneNode& node = m_zone.nodes[i];
            m_model.smooth.node_diagonal(i) = (node.pinned ? 1.0 : node.mass) * Mat3::Identity();
        }
        m_model.gradient = m_zero;
    }

    Coordinates find_move() {
        set_metric();
        Coordinates p = m_zero;
        minimise(m_model, 1.0, 0.0, m_system, m_workspace, p);
        return p;
    }

    void apply(const Coordinates& p) {
        for (std::size_t i = 0; i < m_count; ++i) {
            ZoneBody& body = m_zone.bodies[i];
            body.start = pose_at(body, p.bodies[i]);
            body.inertia = body.start.R * m_inertia_body[i] * body.start.R.transpose();
        }
        for (std::size_t i = 0; i < m_zone.nodes.size(); ++i) m_zone.nodes[i].start += p.nodes[i];
    }

    Zone& m_zone;
    const PassiveBodies& m_passive;
    const std::size_t m_count;  // of dynamic bodies
    std::vector<Mat3> m_inertia_body;
    Coordinates m_zero;
    ContactCoverage m_coverage;
    ContactModel m_model;
    std::vector<int> m_row_contacts;
    BlockSystem m_system;
    ModelWorkspace m_workspace;
    Separation m_result;
};

}  // namespace

Separation separate(Zone zone, const PassiveBodies& passive) { return Separator(zone, passive).run(); }

}  // namespace diffsim
