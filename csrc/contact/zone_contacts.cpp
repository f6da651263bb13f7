#include "contact/zone_contacts.hpp"

#include <algorithm>
#include <cmath>

#include "collision/ccd.hpp"

namespace diffsim {
namespace {

/// Bound on how far any vertex moves when the coordinates change by this much.
double motion_bound(const Vec6& change, double radius) {
    return change.tail<3>().norm() + std::min(change.head<3>().norm(), 2.0) * radius;
}

/// Bound on how far the arc of a vertex leaves its chord over this turn.
double sagitta(const Vec6& change, double radius) {
    const double angle = change.head<3>().norm();
    return radius * std::min(0.125 * angle * angle, 2.0);
}

SweptMesh swept_mesh(const Zone& zone, int body, const Coordinates& begin, const Coordinates& end, double slack) {
    const ZoneBody& b = zone.bodies[body];
    return {
        &zone.mesh(body), {pose_at(b, begin[body]), pose_at(b, end[body])}, zone.model->bodies[b.id].margin + slack};
}

/// Let bodies that do not yield join the zone where its moving bodies come near them.
void join_passive(
    Zone& zone, const PassiveBodies& passive, const std::vector<Box>& dynamic_boxes, Coordinates& begin,
    Coordinates& end) {
    if (passive.bodies.empty()) return;
    std::vector<int> near;
    for (Box box : dynamic_boxes) {
        box.lower += zone.origin;
        box.upper += zone.origin;
        query(passive.tree, box, near);
    }
    std::sort(near.begin(), near.end());
    near.erase(std::unique(near.begin(), near.end()), near.end());
    for (int k : near) {
        const PassiveBody& body = passive.bodies[k];
        const auto is_it = [&](const ZoneBody& other) { return other.id == body.id; };
        if (std::any_of(zone.bodies.begin() + zone.dynamic_count, zone.bodies.end(), is_it)) continue;
        ZoneBody joined;
        joined.id = body.id;
        joined.start = {body.start.R, body.start.t - zone.origin};
        joined.target = body.target;
        zone.bodies.push_back(joined);
        begin.push_back(Vec6::Zero());
        end.push_back(body.target);
    }
}

}  // namespace

void add_contact(Zone& zone, const Contact& contact, int a, int b) {
    const double mass_b = b == kGround ? kInfinity : zone.bodies[b].mass;
    ZoneContact entry;
    entry.contact = contact;
    entry.a = a;
    entry.b = b;
    entry.pair = -1;
    const double margins = zone.model->margin(contact.object_a) + zone.model->margin(contact.object_b);
    entry.range = contact_range(margins, zone.model->thickness);
    entry.stiffness = contact_stiffness(zone.bodies[a].mass, mass_b, zone.compliance);
    zone.contacts.push_back(entry);
}

ContactCoverage collect_contacts(Zone& zone, const PassiveBodies& passive, Coordinates& begin, Coordinates& end) {
    ContactCoverage coverage;
    zone.contacts.clear();
    zone.pairs.clear();
    std::vector<SweptMesh> meshes;
    std::vector<Box> boxes;
    const auto add_body = [&](int i) {
        const Vec6 change = end[i] - begin[i];
        const double radius = zone.mesh(i).radius;
        const bool yields = i < zone.dynamic_count;
        const double slack = yields ? 0.5 * zone.model->thickness + 0.25 * motion_bound(change, radius) : 0.0;
        if (yields) coverage.slack.push_back(slack);
        meshes.push_back(swept_mesh(zone, i, begin, end, slack + sagitta(change, radius)));
        boxes.push_back(swept_box(meshes.back()));
    };
    for (int i = 0; i < zone.dynamic_count; ++i) add_body(i);
    join_passive(zone, passive, boxes, begin, end);
    for (int i = zone.dynamic_count; i < zone.body_count(); ++i) add_body(i);

    if (zone.model->ground.present) {
        std::vector<int> vertices;
        for (int i = 0; i < zone.dynamic_count; ++i) {
            vertices.clear();
            collect_vertices_below(meshes[i], zone.ground_height + zone.model->ground.margin, vertices);
            for (int v : vertices)
                add_contact(zone, {zone.bodies[i].id, kGround, ContactType::vertex_patch, v, -1}, i, kGround);
        }
    }
    if (zone.body_count() > 1) {
        std::vector<FeaturePair> features;
        for (const auto& [i, j] : overlapping_pairs(boxes)) {
            if (i >= zone.dynamic_count) continue;
            features.clear();
            collect_feature_pairs(meshes[i], meshes[j], features);
            if (features.empty()) continue;
            const std::size_t first = zone.contacts.size();
            for (const FeaturePair& f : features)
                add_contact(zone, {zone.bodies[i].id, zone.bodies[j].id, f.type, f.feature_a, f.feature_b}, i, j);
            if (j >= zone.dynamic_count) continue;
            for (std::size_t k = first; k < zone.contacts.size(); ++k)
                zone.contacts[k].pair = static_cast<int>(zone.pairs.size());
            zone.pairs.emplace_back(i, j);
        }
    }
    coverage.begin = begin;
    coverage.end = end;
    return coverage;
}

bool is_covered(const Zone& zone, const ContactCoverage& coverage, const Coordinates& y) {
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const Vec6 segment = coverage.end[i] - coverage.begin[i];
        const Vec6 offset = y[i] - coverage.begin[i];
        const double radius = zone.mesh(i).radius;
        // Nearest point of the segment, with turns weighed by the radius.
        Vec6 weighed = segment;
        weighed.head<3>() *= radius * radius;
        const double length_sq = weighed.dot(segment);
        const double s = length_sq > 0.0 ? std::clamp(weighed.dot(offset) / length_sq, 0.0, 1.0) : 0.0;
        const Vec6 deviation = offset - s * segment;
        if (motion_bound(deviation, radius) > coverage.slack[i]) return false;
    }
    return true;
}

double allowed_step(const Zone& zone, const ZonePoint& point, const Coordinates& y_end, std::vector<Impact>* impacts) {
    if (impacts != nullptr) impacts->clear();
    if (zone.contacts.empty()) return 1.0;
    const int count = zone.body_count();
    std::vector<double> motion(static_cast<std::size_t>(count));
    std::vector<Sweep> sweeps(static_cast<std::size_t>(count));
    for (int i = 0; i < count; ++i) {
        motion[i] = motion_bound(y_end[i] - point.y[i], zone.mesh(i).radius);
        sweeps[i] = {point.poses[i], pose_at(zone.bodies[i], y_end[i])};
    }
    double step = 1.0;
    static const Sweep kNoSweep;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        const bool ground = contact.contact.with_ground();
        // A pair that is already nearer than the floor may use up most of what is left above the pole.
        const double room = point.distances[k] - contact.range.pole;
        CcdOptions ccd;
        const double keep = std::min(contact.range.floor - contact.range.pole, 0.1 * room);
        ccd.min_distance = contact.range.pole + keep;
        ccd.tolerance = 0.2 * keep;
        if (motion[contact.a] + (ground ? 0.0 : motion[contact.b]) < room - 1.2 * keep) continue;
        const double toi = contact_toi(
            *zone.model, contact.contact, sweeps[contact.a], ground ? kNoSweep : sweeps[contact.b], zone.ground_height,
            ccd);
        if (toi == kNoImpact) continue;
        step = std::min(step, toi);
        if (impacts != nullptr) impacts->push_back({static_cast<int>(k), toi});
    }
    return step;
}

}  // namespace diffsim
