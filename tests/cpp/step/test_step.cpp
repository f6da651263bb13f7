#include "step/step.hpp"

#include <algorithm>
#include <stdexcept>

#include "scene_queries.hpp"
#include "step_fixtures.hpp"

namespace test_step {

using namespace diffsim;
using namespace fixtures::steps;

namespace {

void check_thin_plate(bool split) {
    Scene scene;
    scene.options.split = split;
    scene.add_box(Vec3(0.5, 0.5, 0.002), Vec3(0, 0, 0), Vec3::Zero(), BodyKind::static_);
    const fixtures::TriangleMesh mesh = fixtures::grid(4, 4, 0.05);
    scene.add_cloth(mesh, fixtures::moved(mesh.vertices, Mat3::Identity(), Vec3(-0.1, -0.1, 0.05)), {});
    for (Vec3& v : scene.state.node_velocity) v.z() = -10.0;  // 0.1 m in a step
    for (const Vec3& x : scene.step().node_position) CHECK(x.z() > 0.002);
}

void check_other_sheet(bool split) {
    Scene scene;
    scene.options.split = split;
    const fixtures::TriangleMesh mesh = fixtures::grid(3, 3, 0.05), target = fixtures::grid(5, 5, 0.05);
    scene.add_cloth(target, target.vertices, {0, 5, 30, 35});
    scene.add_cloth(mesh, fixtures::moved(mesh.vertices, Mat3::Identity(), Vec3(0.05, 0.06, 0.05)), {});
    for (int i = 36; i < 52; ++i) scene.state.node_velocity[i].z() = -10.0;
    const SceneState end = scene.step();
    CHECK(find_crossing(scene.model, end).a == kNobody);
    double lowest = kInfinity, highest = -kInfinity;
    for (int i = 0; i < 36; ++i) lowest = std::min(lowest, end.node_position[i].z());
    for (int i = 36; i < 52; ++i) highest = std::max(highest, end.node_position[i].z());
    CHECK(highest > lowest);
}

}  // namespace

TEST(a_fast_sheet_does_not_pass_through_a_thin_plate) {
    check_thin_plate(false);
    check_thin_plate(true);
}
TEST(a_fast_sheet_does_not_pass_through_another) {
    check_other_sheet(false);
    check_other_sheet(true);
}

TEST(momentum_is_kept_in_a_collision) {
    Scene scene = free_collision();
    scene.parameters.gravity.setZero();
    const SceneState end = scene.step();
    Vec3 before = Vec3::Zero(), after = Vec3::Zero();
    for (int i = 0; i < 2; ++i) {
        before += scene.parameters.mass[i] * scene.state.bodies[i].velocity;
        after += scene.parameters.mass[i] * end.bodies[i].velocity;
    }
    CHECK((end.bodies[0].velocity - scene.state.bodies[0].velocity).norm() > 0.1);
    CHECK_NEAR(after, before, 1e-10 * before.norm());
}

TEST(flight_follows_its_formula) {
    const Scene scene = tumbling();
    const SceneState end = scene.step();
    const BodyState& start = scene.state.bodies[0];
    const Vec3 velocity = start.velocity + kDt * (scene.parameters.gravity + scene.control.bodies[0].force / 2.0);
    CHECK_NEAR(end.bodies[0].velocity, velocity, 1e-14);
    CHECK_NEAR(end.bodies[0].position, start.position + kDt * velocity, 1e-14);
    CHECK_NEAR(end.bodies[0].orientation.norm(), 1.0, 1e-15);
}

TEST(a_step_depends_on_nothing_but_its_inputs) {
    StepWorkspace workspace;
    for (int round = 0; round < 2; ++round) {
        for (const Scene& scene : {tilted_landing(), free_collision(), pushed_ball()}) {
            StepInfo fresh, used;
            StepRecord record;
            const SceneState a = scene.step(fresh, round == 0 ? nullptr : &record);
            const SceneState b = step(
                scene.model, scene.options, scene.parameters, scene.state, scene.control, workspace, used, nullptr);
            CHECK(fresh.signature == used.signature);
            for (std::size_t i = 0; i < a.bodies.size(); ++i) {
                CHECK(a.bodies[i].position == b.bodies[i].position);
                CHECK(a.bodies[i].orientation == b.bodies[i].orientation);
                CHECK(a.bodies[i].velocity == b.bodies[i].velocity);
                CHECK(a.bodies[i].angular_velocity == b.bodies[i].angular_velocity);
            }
        }
    }
}

TEST(objects_that_touch_are_refused_by_name) {
    Scene scene;
    scene.add_box(Vec3(0.1, 0.1, 0.1), Vec3(0, 0, 0.1));
    scene.add_ground();
    scene.model.bodies[0].name = "crate";
    CHECK_THROWS_WITH(scene.step(), std::invalid_argument, "'crate' and 'ground'");
}

}  // namespace test_step
