#include "scene_queries.hpp"

#include <Eigen/LU>

#include "contact/separation.hpp"
#include "math/rotation.hpp"

namespace diffsim {

SceneState separate_state(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state) {
    Zone zone;
    zone.model = &model;
    set_compliance(zone, options.compliance);
    zone.ground_height = model.ground.height;
    PassiveBodies passive;
    std::vector<Box> boxes;
    for (int i = 0; i < model.body_count(); ++i) {
        const Pose pose{quaternion_to_matrix(state.bodies[i].orientation), state.bodies[i].position};
        if (!model.bodies[i].is_dynamic()) {
            passive.bodies.push_back({i, pose, Vec6::Zero()});
            boxes.push_back(swept_box({&model.bodies[i].mesh, {pose, pose}, model.bodies[i].margin}));
            continue;
        }
        ZoneBody body;
        body.id = i;
        body.start = pose;
        body.mass = parameters.mass[i];
        body.inertia = pose.R * parameters.inertia[i] * pose.R.transpose();
        body.inverse_inertia = body.inertia.inverse();
        zone.bodies.push_back(body);
    }
    passive.tree = build_box_tree(boxes);
    zone.dynamic_count = zone.body_count();
    if (!model.cloths.empty()) {
        SceneControl control;
        control.node_force.assign(state.node_position.size(), Vec3::Zero());
        control.node_velocity = control.node_force;
        zone.cloth_parameters = &parameters.cloths;
        for (int c = 0; c < model.cloth_count(); ++c) add_cloth(zone, c, state, control, parameters);
    }
    if (zone.bodies.empty() && zone.nodes.empty()) return state;
    const Separation separation = separate(zone, passive);
    SceneState result = state;
    result.node_position = separation.nodes;
    for (std::size_t k = 0; k < separation.poses.size(); ++k) {
        const Pose &from = zone.bodies[k].start, &to = separation.poses[k];
        BodyState& body = result.bodies[zone.bodies[k].id];
        body.position = to.t;
        const Mat3 turn = to.R * from.R.transpose();
        if (turn.isIdentity(4.0 * kEpsilon)) continue;
        body.orientation = quaternion_multiply(exp_quaternion(log_rotation(turn)), body.orientation).normalized();
    }
    return result;
}

CrossingObjects find_crossing(const Model& model, const SceneState& state) {
    std::vector<Pose> poses;
    std::vector<Box> boxes;
    for (int i = 0; i < model.body_count(); ++i) {
        poses.push_back({quaternion_to_matrix(state.bodies[i].orientation), state.bodies[i].position});
        boxes.push_back(transformed(model.bodies[i].mesh.tree.nodes[0].box, poses.back()));
    }
    for (const auto& [a, b] : overlapping_pairs(build_box_tree(boxes))) {
        if (!model.bodies[a].is_dynamic() && !model.bodies[b].is_dynamic()) continue;
        if (meshes_cross(model.bodies[a].mesh, poses[a], model.bodies[b].mesh, poses[b])) return {a, b};
    }
    return {};
}

NearestObjects nearest_objects(const Model& model, const SceneState& state) {
    // Every pair of features, box trees aside: a diagnostic, not part of the step.
    NearestObjects nearest;
    std::vector<Pose> poses;
    for (const BodyState& body : state.bodies) poses.push_back({quaternion_to_matrix(body.orientation), body.position});
    const auto consider = [&](double distance, int a, int b) {
        if (distance < nearest.distance) nearest = {distance, a, b};
    };
    for (int a = 0; a < model.body_count(); ++a) {
        if (model.ground.present && model.bodies[a].kind != BodyKind::static_)
            for (int v : model.bodies[a].mesh.active_vertices)
                consider(
                    (poses[a] * model.bodies[a].mesh.vertices[v]).z() - model.ground.height - model.bodies[a].margin -
                        model.ground.margin,
                    a, kGround);
        for (int b = a + 1; b < model.body_count(); ++b) {
            if (model.bodies[a].kind == BodyKind::static_ && model.bodies[b].kind == BodyKind::static_) continue;
            const double margins = model.bodies[a].margin + model.bodies[b].margin;
            // Boxes inflated by half of the best distance so far bound what can still improve on it.
            const Pose origin_a{poses[a].R, poses[a].t - poses[a].t}, origin_b{poses[b].R, poses[b].t - poses[a].t};
            const Box box_a = transformed(model.bodies[a].mesh.tree.nodes[0].box, origin_a);
            const Box box_b = transformed(model.bodies[b].mesh.tree.nodes[0].box, origin_b);
            const Vec3 gap = (box_a.lower - box_b.upper).cwiseMax(box_b.lower - box_a.upper).cwiseMax(0.0);
            if (gap.norm() - margins >= nearest.distance) continue;
            double reach = nearest.distance + margins;
            if (reach == kInfinity)
                reach = (poses[a].t - poses[b].t).norm() + model.bodies[a].mesh.radius + model.bodies[b].mesh.radius;
            std::vector<FeaturePair> pairs;
            collect_feature_pairs(
                {&model.bodies[a].mesh, {origin_a, origin_a}, 0.5 * reach},
                {&model.bodies[b].mesh, {origin_b, origin_b}, 0.5 * reach}, pairs);
            for (const FeaturePair& f : pairs)
                consider(
                    contact_geometry(model, {a, b, f.type, f.feature_a, f.feature_b}, origin_a, origin_b, 0.0)
                            .distance -
                        margins,
                    a, b);
        }
    }
    return nearest;
}

}  // namespace diffsim
