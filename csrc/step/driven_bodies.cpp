#include "step/driven_bodies.hpp"

#include <algorithm>

#include "collision/ccd.hpp"
#include "step/body_step.hpp"

namespace diffsim {
namespace {

/// A body at both ends of its motion.
struct MovedBody {
    const CollisionMesh& mesh;
    Pose begin, end;
    double reach;

    MovedBody(const Model& model, const PassiveBody& body)
        : mesh(model.bodies[body.id].mesh), begin(body.start), end(body.start), reach(model.bodies[body.id].margin) {
        ZoneBody moving;
        moving.start = body.start;
        end = pose_at(moving, body.target);
    }
    SweptMesh swept() const { return {&mesh, {begin, end}, reach}; }
    SweptMesh at_start() const { return {&mesh, {begin, begin}, 0.0}; }
    SweptSurface surface() const { return {{&mesh, &begin, nullptr}, {&mesh, &end, nullptr}}; }
};

/// How much of the way is free for a driven body and one that stands, at most `part`. Features that are nearer than any
/// two objects keep to each other are left alone.
double free_part(
    const Model& model, int driven, const MovedBody& moved, int other, const MovedBody& obstacle, double part) {
    const ContactRange range = contact_range(model.margin_sum(driven, other), model.pair_thickness(driven, other));
    std::vector<FeaturePair> features;
    collect_feature_pairs(moved.swept(), obstacle.swept(), features);
    for (const FeaturePair& f : features) {
        const Contact contact{driven, other, f.type, f.feature_a, f.feature_b};
        const double room =
            ContactGeometry(contact, moved.surface().begin, obstacle.surface().begin, 0.0).distance - range.pole;
        if (!(room > 0.0)) continue;
        CcdOptions ccd;
        const double keep = std::min(range.floor - range.pole, 0.1 * room);
        ccd.min_distance = range.pole + keep;
        ccd.tolerance = 0.2 * keep;
        ccd.until = part;
        const double toi = contact_toi(contact, moved.surface(), obstacle.surface(), 0.0, ccd);
        if (toi != kNoImpact) part = std::min(part, toi);
    }
    return part;
}

}  // namespace

DriveStop find_static_obstacle(const Model& model, const PassiveBodies& passive, const PassiveBody& driven) {
    DriveStop stop;
    const MovedBody moved(model, driven);
    std::vector<int> near;
    query(passive.tree, space_of_driven_body(model, driven.id, driven.start, driven.target), near);
    std::sort(near.begin(), near.end());
    for (int k : near) {
        const PassiveBody& other = passive.bodies[k];
        if (model.bodies[other.id].kind != BodyKind::static_) continue;
        const MovedBody obstacle(model, other);
        const double part = free_part(model, driven.id, moved, other.id, obstacle, stop.part);
        // Those that are built into each other, as a shaft and its bearing, stay so.
        if (part < stop.part && !meshes_cross(moved.at_start(), obstacle.at_start())) stop = {part, other.id};
    }
    return stop;
}

}  // namespace diffsim
