#include "step/step_start.hpp"

#include <Eigen/LU>
#include <algorithm>
#include <utility>

#include "collision/candidates.hpp"
#include "math/rotation.hpp"

namespace diffsim {
namespace {

/// Bound on how far vertices leave the straight line between the ends of a turn.
double sagitta(const Vec6& motion, double radius) {
    return radius * std::min(0.125 * motion.head<3>().squaredNorm(), 2.0);
}

}  // namespace

ZoneBody moving_body(
    int id, const BodyState& state, const BodyControl& control, const Parameters& parameters,
    const FreeRotation& rotation, double dt) {
    ZoneBody body;
    body.id = id;
    body.start = {quaternion_to_matrix(state.orientation), state.position};
    body.inertia = body.start.R * parameters.inertia[id] * body.start.R.transpose();
    body.inverse_inertia = body.inertia.inverse();
    body.mass = parameters.mass[id];
    body.target << rotation.rotation, dt * free_velocity(id, state, control, parameters, dt);
    body.warm << dt * state.angular_velocity, dt * state.velocity;
    if (rotation.substeps == 0) body.warm.head<3>().setZero();  // it is held
    return body;
}

void add_cloth(Zone& zone, int id, const SceneState& state, const SceneControl& control, const Parameters& parameters) {
    const Cloth& cloth = zone.model->cloths[id];
    ZoneCloth entry;
    entry.id = id;
    entry.first_node = zone.node_count();
    entry.start = elastic_start(cloth, state.node_position.data() + cloth.first_node);
    zone.cloths.push_back(std::move(entry));
    for (int k = 0; k < cloth.node_count(); ++k) {
        const int i = cloth.first_node + k;
        ZoneNode node;
        node.start = state.node_position[i] - zone.origin;
        node.mass = parameters.cloths[id].density * cloth.node_area[k];
        node.pinned = cloth.pinned[k] != 0;
        const Vec3 velocity =
            node.pinned
                ? control.node_velocity[i]
                : free_node_velocity(state.node_velocity[i], control.node_force[i], node.mass, parameters, zone.dt);
        node.target = zone.dt * velocity;
        node.warm = zone.dt * state.node_velocity[i];
        zone.nodes.push_back(node);
    }
}

Box space_of_body(const Model& model, const ZoneBody& body) {
    const CollisionMesh& mesh = model.bodies[body.id].mesh;
    const double arc = std::max(sagitta(body.target, mesh.radius), sagitta(body.warm, mesh.radius));
    const double reach = model.bodies[body.id].margin + 0.5 * model.own_thickness(body.id) + arc;
    Box box = swept_box({&mesh, {pose_at(body, body.warm), pose_at(body, body.target)}, reach});
    Box start = transformed(mesh.tree.nodes[0].box, body.start);
    start.inflate(reach);
    box.include(start);
    return box;
}

Box space_of_driven_body(const Model& model, int id, const Pose& start, const Vec6& motion) {
    const CollisionMesh& mesh = model.bodies[id].mesh;
    ZoneBody driven;
    driven.start = start;
    const double reach = model.bodies[id].margin + sagitta(motion, mesh.radius);
    return swept_box({&mesh, {start, pose_at(driven, motion)}, reach});
}

Box space_of_cloth(
    const Cloth& cloth, const SceneState& state, const SceneControl& control, const Parameters& parameters,
    double thickness, double dt) {
    Box box;
    for (int k = 0; k < cloth.node_count(); ++k) {
        const int node = cloth.first_node + k;
        const Vec3 &x = state.node_position[node], &v = state.node_velocity[node];
        box.include(x);
        if (cloth.pinned[k]) {
            box.include(x + dt * control.node_velocity[node]);
            continue;
        }
        box.include(x + dt * v);
        box.include(x + dt * (v + dt * parameters.gravity));
    }
    box.inflate(cloth.margin + 0.5 * thickness);
    return box;
}

}  // namespace diffsim
