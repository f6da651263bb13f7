#include "step_fixtures.hpp"

#include <utility>

namespace fixtures::steps {

Scene::Scene() {
    options.dt = kDt;
    model.thickness = kThickness;
    parameters.gravity = Vec3(0.2, 0.1, -9.81);
}

int Scene::add(Body body, const Vec3& position, const Vec3& turn, double mass, const Mat3& inertia) {
    model.bodies.push_back(std::move(body));
    BodyState placed;
    placed.position = position;
    placed.orientation = exp_quaternion(turn);
    state.bodies.push_back(placed);
    control.bodies.emplace_back();
    parameters.mass.push_back(mass);
    parameters.inertia.push_back(inertia);
    return model.body_count() - 1;
}

int Scene::add_box(const Vec3& half, const Vec3& position, const Vec3& turn, BodyKind kind, double mass) {
    return add(
        fixtures::body(fixtures::box(half), 0.5 * kThickness, kind), position, turn, mass,
        fixtures::box_inertia(half, mass));
}

int Scene::add_ball(double radius, const Vec3& position, double mass) {
    Body ball;
    ball.margin = radius;
    ball.mesh = build_collision_mesh({Vec3::Zero()}, {});
    return add(ball, position, Vec3::Zero(), mass, 0.4 * mass * radius * radius * Mat3::Identity());
}

int Scene::add_cloth(
    const fixtures::TriangleMesh& rest, const std::vector<Vec3>& nodes, const std::vector<int>& pinned,
    const ClothParameters& material) {
    Cloth cloth = fixtures::cloth(rest, 0.5 * kThickness);
    cloth.first_node = model.node_count();
    for (int node : pinned) cloth.pinned[node] = 1;
    model.cloths.push_back(cloth);
    state.node_position.insert(state.node_position.end(), nodes.begin(), nodes.end());
    for (std::vector<Vec3>* list : {&state.node_velocity, &control.node_force, &control.node_velocity})
        list->resize(state.node_position.size(), Vec3::Zero());
    parameters.cloths.push_back(material);
    return model.cloth_count() - 1;
}

SceneState Scene::step(StepInfo& info, StepRecord* record) const {
    StepWorkspace workspace;
    return diffsim::step(model, options, parameters, state, control, workspace, info, record);
}

SceneState Scene::step() const {
    StepInfo info;
    const SceneState result = step(info);
    CHECK(info.converged);
    return result;
}

Scene tumbling() {
    Scene scene;
    scene.add_box(Vec3(0.1, 0.2, 0.3), Vec3(1, 2, 3), Vec3(0.3, -0.5, 0.9));
    scene.state.bodies[0].velocity = Vec3(1, 2, 3);
    scene.state.bodies[0].angular_velocity = Vec3(9, -7, 5);
    scene.control.bodies[0].force = Vec3(1, -2, 3);
    scene.control.bodies[0].torque = Vec3(0.1, 0.2, -0.3);
    return scene;
}

Scene tilted_landing() {
    Scene scene = tumbling();
    scene.add_ground();
    scene.state.bodies[0].position = Vec3(0.1, 0.2, 0.33);
    scene.state.bodies[0].velocity.z() = -12.0;
    return scene;
}

Scene free_collision() {
    Scene scene;
    scene.add(
        fixtures::body(fixtures::tetrahedron(0.1), 0.5 * kThickness), Vec3(0, 0, 0), Vec3(0.3, 0.2, 0.1), 2.0,
        0.008 * Mat3::Identity());
    scene.add_box(Vec3(0.1, 0.15, 0.12), Vec3(0.3, 0.05, 0.02), Vec3(-0.4, 0.2, 0.5), BodyKind::dynamic, 5.0);
    scene.state.bodies[0].velocity = Vec3(14, 0.5, 0);
    scene.state.bodies[0].angular_velocity = Vec3(1, 2, 3);
    scene.state.bodies[1].velocity = Vec3(-2, 0, 0.3);
    return scene;
}

Scene pushed_ball() {
    Scene scene;
    scene.add_ball(0.1, Vec3(0.205, 0.03, 0.02), 0.7);
    scene.add_box(Vec3(0.1, 0.2, 0.2), Vec3(0, 0, 0), Vec3(0.05, 0.1, 0), BodyKind::kinematic);
    scene.add_ball(0.15, Vec3(0.47, 0.1, 0.05), 1.3);
    scene.control.bodies[1].velocity = Vec3(6.0, 0.3, 0.2);
    scene.control.bodies[1].angular_velocity = Vec3(0.5, -0.3, 2.0);
    return scene;
}

}  // namespace fixtures::steps
