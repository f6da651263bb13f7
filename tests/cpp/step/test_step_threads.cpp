#include "step_fixtures.hpp"

namespace test_step_threads {

using namespace diffsim;
using namespace fixtures::steps;

namespace {

/// Boxes on the ground and balls on them, a plate that pushes them and one that stands in their way, and a sheet.
Scene many_zones() {
    Scene scene;
    check::Random random(7);
    scene.add_ground();
    const int plate = scene.add_box(Vec3(9, 0.05, 0.3), Vec3(8, -0.31, 0.35), Vec3::Zero(), BodyKind::kinematic);
    scene.control.bodies[plate].velocity = scene.state.bodies[plate].velocity = Vec3(0, 0.5, 0);
    scene.add_box(Vec3(9, 0.05, 0.3), Vec3(8, 0.76, 0.301), Vec3::Zero(), BodyKind::static_);
    for (int k = 0; k < 40; ++k) {
        const double x = 0.8 * (k / 2), y = 0.5 * (k % 2);
        scene.add_box(Vec3(0.2, 0.2, 0.15), Vec3(x, y, 0.155), 0.01 * fixtures::random_vec3(random));
        scene.add_ball(0.1, Vec3(x + 0.02, y, 0.425), 0.5);
        scene.state.bodies.back().velocity = Vec3(0, 0, -1);
    }
    const fixtures::TriangleMesh sheet = fixtures::grid(4, 4, 0.1);
    std::vector<Vec3> nodes = sheet.vertices;
    for (Vec3& x : nodes) x += Vec3(0, 0, 0.55);
    scene.add_cloth(sheet, nodes, {});
    return scene;
}

}  // namespace

TEST(a_step_and_its_backward_do_not_depend_on_the_number_of_threads) {
    Scene scene = many_zones();
    for (int time = 0; time < 4; ++time) {
        std::vector<SceneState> ends;
        std::vector<SceneStateGradient> gradients;
        std::vector<ParameterGradient> by_parameters;
        for (const int threads : {1, 2, 3}) {
            StepWorkspace workspace(threads);
            StepInfo info;
            StepRecord record;
            ends.push_back(step(
                scene.model, scene.options, scene.parameters, scene.state, scene.control, workspace, info, &record));
            if (time > 0) CHECK(info.zones >= 5);
            const std::size_t count = scene.model.bodies.size(), nodes = scene.state.node_position.size();
            SceneStateGradient gradient;
            for (std::size_t i = 0; i < count; ++i) {
                const Vec3 weight(1.0, 0.1 * static_cast<double>(i % 7), -0.5);
                gradient.bodies.push_back({weight, 0.1 * weight, kDt * weight, kDt * weight});
            }
            gradient.node_position.assign(nodes, Vec3(1, 2, 3));
            gradient.node_velocity.assign(nodes, Vec3::Zero());
            SceneControlGradient control;
            control.bodies.resize(count);
            control.node_force.assign(nodes, Vec3::Zero());
            control.node_velocity = control.node_force;
            ParameterGradient parameters;
            parameters.mass.assign(count, 0.0);
            parameters.inertia.assign(count, Mat3::Zero());
            parameters.cloths.resize(scene.model.cloths.size());
            step_backward(
                scene.model, scene.options, scene.parameters, scene.control, record, GradientNeeds{}, workspace,
                gradient, control, parameters);
            gradients.push_back(gradient);
            by_parameters.push_back(parameters);
        }
        for (std::size_t k = 1; k < ends.size(); ++k) {
            for (std::size_t i = 0; i < ends[0].bodies.size(); ++i) {
                NOTE(i);
                CHECK(ends[0].bodies[i].position == ends[k].bodies[i].position);
                CHECK(ends[0].bodies[i].orientation == ends[k].bodies[i].orientation);
                CHECK(ends[0].bodies[i].velocity == ends[k].bodies[i].velocity);
                CHECK(gradients[0].bodies[i].position == gradients[k].bodies[i].position);
                CHECK(gradients[0].bodies[i].orientation == gradients[k].bodies[i].orientation);
                CHECK(by_parameters[0].mass[i] == by_parameters[k].mass[i]);
                CHECK(by_parameters[0].inertia[i] == by_parameters[k].inertia[i]);
            }
            CHECK(ends[0].node_position == ends[k].node_position);
            CHECK(gradients[0].node_position == gradients[k].node_position);
            CHECK(by_parameters[0].gravity == by_parameters[k].gravity);
            CHECK(by_parameters[0].cloths[0].stretch == by_parameters[k].cloths[0].stretch);
        }
        scene.state = ends[0];
    }
}

}  // namespace test_step_threads
