#include <functional>

#include "step_fixtures.hpp"

namespace test_step_gradient {

using namespace diffsim;
using namespace fixtures::steps;

namespace {

constexpr double kStep = 1e-6;           // of positions, turns and speeds times dt [m or rad]
constexpr double kNodeForceStep = 3e-6;  // [N]; moves a node of 0.3 g by kStep in a step
// Of a gradient's norm: solutions are good to about 1e-13 m, differenced over kStep; velocities divide both by dt.
constexpr double kDifferences = 1e-6;

/// One kind of input: how to move it by a vector, and its gradient.
struct Input {
    const char* name;
    Eigen::Index size;
    double step;
    std::function<void(Scene&, const VectorX&)> move;
    VectorX gradient;
};

/// Weights of a loss that is linear in the final state, its turns counted from the final orientation.
struct Loss {
    std::vector<BodyStateGradient> weights;
    std::vector<Vec3> position_weights, velocity_weights;  // of the nodes
    SceneState reference;

    Loss(const Scene& scene, std::uint64_t seed) : reference(scene.step()) {
        check::Random random(seed);
        const auto vec3 = [&](double size) { return fixtures::random_vec3(random, size); };
        for (int i = 0; i < scene.model.body_count(); ++i)
            weights.push_back({vec3(1.0), vec3(1.0), vec3(kDt), vec3(kDt)});
        for (int i = 0; i < scene.model.node_count(); ++i) {
            position_weights.push_back(vec3(1.0));
            velocity_weights.push_back(vec3(kDt));
        }
    }
    double operator()(const Scene& scene) const {
        const SceneState end = scene.step();
        double loss = 0.0;
        for (std::size_t i = 0; i < weights.size(); ++i) {
            const BodyStateGradient& w = weights[i];
            const Mat3 turn = quaternion_to_matrix(end.bodies[i].orientation) *
                              quaternion_to_matrix(reference.bodies[i].orientation).transpose();
            loss += w.position.dot(end.bodies[i].position - reference.bodies[i].position) +
                    w.orientation.dot(log_rotation(turn)) +
                    w.velocity.dot(end.bodies[i].velocity - reference.bodies[i].velocity) +
                    w.angular_velocity.dot(end.bodies[i].angular_velocity - reference.bodies[i].angular_velocity);
        }
        for (std::size_t i = 0; i < position_weights.size(); ++i)
            loss += position_weights[i].dot(end.node_position[i] - reference.node_position[i]) +
                    velocity_weights[i].dot(end.node_velocity[i] - reference.node_velocity[i]);
        return loss;
    }
};

/// All inputs of one body, with their gradients.
std::vector<Input> inputs_of(
    int i, BodyKind kind, const BodyStateGradient& state, const BodyControl& control,
    const ParameterGradient& parameters) {
    std::vector<Input> inputs = {
        {"position", 3, kStep, [i](Scene& s, const VectorX& x) { s.state.bodies[i].position += x; }, state.position},
        {"orientation", 3, kStep,
         [i](Scene& s, const VectorX& x) {
             s.state.bodies[i].orientation =
                 quaternion_multiply(exp_quaternion(Vec3(x)), s.state.bodies[i].orientation);
         },
         state.orientation}};
    if (kind == BodyKind::kinematic) {
        inputs.push_back(
            {"driven velocity", 3, kStep / kDt, [i](Scene& s, const VectorX& x) { s.control.bodies[i].velocity += x; },
             control.velocity});
        inputs.push_back(
            {"driven angular velocity", 3, kStep / kDt,
             [i](Scene& s, const VectorX& x) { s.control.bodies[i].angular_velocity += x; }, control.angular_velocity});
    }
    if (kind != BodyKind::dynamic) return inputs;
    const Mat3& I = parameters.inertia[i];
    VectorX by_inertia(6);
    by_inertia << I(0, 0), I(1, 1), I(2, 2), 2.0 * I(0, 1), 2.0 * I(0, 2), 2.0 * I(1, 2);
    inputs.push_back(
        {"velocity", 3, kStep / kDt, [i](Scene& s, const VectorX& x) { s.state.bodies[i].velocity += x; },
         state.velocity});
    inputs.push_back(
        {"angular velocity", 3, kStep / kDt,
         [i](Scene& s, const VectorX& x) { s.state.bodies[i].angular_velocity += x; }, state.angular_velocity});
    inputs.push_back(
        {"force", 3, 1e-2, [i](Scene& s, const VectorX& x) { s.control.bodies[i].force += x; }, control.force});
    inputs.push_back(
        {"torque", 3, 1e-4, [i](Scene& s, const VectorX& x) { s.control.bodies[i].torque += x; }, control.torque});
    inputs.push_back(
        {"mass", 1, 1e-3, [i](Scene& s, const VectorX& x) { s.parameters.mass[i] += x[0]; },
         VectorX::Constant(1, parameters.mass[i])});
    inputs.push_back(
        {"inertia", 6, 1e-5,
         [i](Scene& s, const VectorX& x) {
             Mat3 change;
             change << x[0], x[3], x[4], x[3], x[1], x[5], x[4], x[5], x[2];
             s.parameters.inertia[i] += change;
         },
         by_inertia});
    return inputs;
}

/// All inputs of the cloths' nodes, free and pinned apart, with their gradients.
std::vector<Input> inputs_of_nodes(
    const Model& model, const SceneStateGradient& state, const SceneControlGradient& control) {
    std::vector<Input> inputs;
    for (const bool pinned : {false, true}) {
        std::vector<int> nodes;
        for (const Cloth& cloth : model.cloths)
            for (int k = 0; k < cloth.node_count(); ++k)
                if ((cloth.pinned[k] != 0) == pinned) nodes.push_back(cloth.first_node + k);
        if (nodes.empty()) continue;
        const auto add = [&](const char* name, double step, auto list, const std::vector<Vec3>& gradient) {
            VectorX of_these(3 * static_cast<Eigen::Index>(nodes.size()));
            for (std::size_t k = 0; k < nodes.size(); ++k)
                of_these.segment<3>(3 * static_cast<Eigen::Index>(k)) = gradient[nodes[k]];
            inputs.push_back(
                {name, of_these.size(), step,
                 [nodes, list](Scene& s, const VectorX& x) {
                     for (std::size_t k = 0; k < nodes.size(); ++k)
                         list(s)[nodes[k]] += x.segment<3>(3 * static_cast<Eigen::Index>(k));
                 },
                 of_these});
        };
        add(
            pinned ? "pinned position" : "node position", kStep,
            [](Scene& s) -> std::vector<Vec3>& { return s.state.node_position; }, state.node_position);
        add(
            pinned ? "pinned start velocity" : "node velocity", kStep / kDt,
            [](Scene& s) -> std::vector<Vec3>& { return s.state.node_velocity; }, state.node_velocity);
        add(
            pinned ? "force on pinned" : "node force", kNodeForceStep,
            [](Scene& s) -> std::vector<Vec3>& { return s.control.node_force; }, control.node_force);
        add(
            pinned ? "driven node velocity" : "drive of free nodes", kStep / kDt,
            [](Scene& s) -> std::vector<Vec3>& { return s.control.node_velocity; }, control.node_velocity);
    }
    return inputs;
}

/// The parameters of one cloth, each by a part of itself.
std::vector<Input> inputs_of_cloth(int i, const Scene& scene, const ParameterGradient& parameters) {
    std::vector<Input> inputs;
    const auto add = [&](const char* name, double ClothParameters::* field) {
        inputs.push_back(
            {name, 1, 1e-4 * scene.parameters.cloths[i].*field,
             [i, field](Scene& s, const VectorX& x) { s.parameters.cloths[i].*field += x[0]; },
             VectorX::Constant(1, parameters.cloths[i].*field)});
    };
    add("density", &ClothParameters::density);
    add("stretch", &ClothParameters::stretch);
    add("shear", &ClothParameters::shear);
    add("bend", &ClothParameters::bend);
    add("damping", &ClothParameters::damping);
    return inputs;
}

/// The backward of one step against central differences of the step, input by input, each
/// along a random direction.
void check_step_gradient(const Scene& scene, int least_contacts, double tolerance = kDifferences) {
    StepInfo info;
    StepRecord record;
    scene.step(info, &record);
    CHECK(info.converged);
    CHECK(info.contacts >= least_contacts);
    const Loss loss(scene, 1);
    const std::size_t count = scene.model.bodies.size();
    SceneStateGradient gradient;
    gradient.bodies = loss.weights;
    gradient.node_position = loss.position_weights;
    gradient.node_velocity = loss.velocity_weights;
    SceneControlGradient control;
    control.bodies.resize(count);
    control.node_force.assign(loss.position_weights.size(), Vec3::Zero());
    control.node_velocity = control.node_force;
    ParameterGradient parameters;
    parameters.cloths.resize(scene.model.cloths.size());
    parameters.mass.assign(count, 0.0);
    parameters.inertia.assign(count, Mat3::Zero());
    StepWorkspace workspace;
    step_backward(
        scene.model, scene.options, scene.parameters, scene.control, record, GradientNeeds{}, workspace, gradient,
        control, parameters);

    std::vector<Input> inputs = {
        {"gravity", 3, 1e-2, [](Scene& s, const VectorX& x) { s.parameters.gravity += x; }, parameters.gravity}};
    for (int i = 0; i < static_cast<int>(count); ++i)
        for (Input& input : inputs_of(i, scene.model.bodies[i].kind, gradient.bodies[i], control.bodies[i], parameters))
            inputs.push_back(std::move(input));
    for (Input& input : inputs_of_nodes(scene.model, gradient, control)) inputs.push_back(std::move(input));
    for (int i = 0; i < scene.model.cloth_count(); ++i)
        for (Input& input : inputs_of_cloth(i, scene, parameters)) inputs.push_back(std::move(input));
    check::Random random(2);
    for (const Input& input : inputs) {
        NOTE(input.name);
        VectorX direction = random.vector(input.size);
        direction /= direction.cwiseAbs().maxCoeff();
        const auto moved = [&](const VectorX& t) {
            Scene changed = scene;
            input.move(changed, t[0] * direction);
            return loss(changed);
        };
        const double numeric = fixtures::numeric_gradient(moved, VectorX::Zero(1), input.step)[0];
        // Rounding of the solution, which a small gradient over a small step cannot hide.
        constexpr double kSolution = 1e-13;
        CHECK(input.gradient.allFinite());
        CHECK_NEAR(input.gradient.dot(direction), numeric, tolerance * input.gradient.norm() + kSolution / input.step);
    }
    if (count > 0) CHECK(gradient.bodies[0].position.norm() > 1e-2);
    for (const ClothParameters& cloth : parameters.cloths)
        for (const double by : {cloth.density, cloth.stretch, cloth.shear, cloth.bend, cloth.damping}) CHECK(by != 0.0);
    CHECK(parameters.gravity.norm() > 1e-6);
}

Scene box_on_static_edge() {
    Scene scene;
    scene.add_box(Vec3(0.1, 0.1, 0.1), Vec3(0.1, 0.02, 0.155), Vec3(0.3, 0.7, 0.1));
    scene.add_box(Vec3(0.15, 0.3, 0.05), Vec3(0, 0, 0), Vec3(0, 0, 0.2), BodyKind::static_);
    scene.state.bodies[0].velocity.z() = -8.0;
    return scene;
}

/// A sheet of 3 x 3 nodes that hangs by two corners, one of which is driven, pulled by forces.
Scene hanging_sheet() {
    Scene scene;
    check::Random random(31);
    const fixtures::TriangleMesh mesh = fixtures::grid(2, 2, 0.1);
    scene.add_cloth(mesh, fixtures::shaken(mesh.vertices, random, 0.01), {0, 2});
    for (int i = 0; i < 9; ++i) {
        scene.state.node_velocity[i] = fixtures::random_vec3(random, 1.0);
        scene.control.node_force[i] = fixtures::random_vec3(random, 0.05);
    }
    scene.control.node_velocity[2] = Vec3(0.5, 0.2, -0.3);
    return scene;
}

/// A box that falls on a sheet whose corners are held.
Scene caught_box() {
    Scene scene;
    scene.add_box(Vec3(0.05, 0.06, 0.03), Vec3(0.14, 0.16, 0.052), Vec3(0.3, 0.2, 0.1), BodyKind::dynamic, 0.3);
    scene.state.bodies[0].velocity = Vec3(0.3, 0.1, -3.0);
    check::Random random(32);
    const fixtures::TriangleMesh mesh = fixtures::grid(3, 3, 0.1);
    scene.add_cloth(mesh, fixtures::shaken(mesh.vertices, random, 0.003), {0, 3, 12, 15});
    scene.control.node_velocity[15] = Vec3(0.2, 0.1, 0.4);
    return scene;
}

/// A sheet that lands on the edge of a fixed box, a driven one and the ground.
Scene landing_sheet() {
    Scene scene;
    scene.add_box(Vec3(0.06, 0.2, 0.05), Vec3(0.03, 0.15, 0.05), Vec3(0.0, 0.3, 0.2), BodyKind::static_);
    scene.add_box(Vec3(0.05, 0.05, 0.05), Vec3(0.26, 0.15, 0.09), Vec3(0.3, 0.1, 0.2), BodyKind::kinematic);
    scene.control.bodies[1].velocity = Vec3(0.2, 0.1, 0.9);
    scene.control.bodies[1].angular_velocity = Vec3(1.0, 2.0, -3.0);
    scene.add_ground();
    check::Random random(33);
    const fixtures::TriangleMesh mesh = fixtures::grid(4, 3, 0.1);
    std::vector<Vec3> nodes = fixtures::shaken(mesh.vertices, random, 0.002);
    for (Vec3& x : nodes) x.z() += 0.16 - 1.5 * (x.y() - 0.15) * (x.y() - 0.15) * 4.0;
    scene.add_cloth(mesh, nodes, {});
    for (Vec3& v : scene.state.node_velocity) v = Vec3(0.2, 0.1, -6.0) + fixtures::random_vec3(random, 0.2);
    return scene;
}

/// Two sheets that hit each other, one of them folded onto itself.
Scene meeting_sheets() {
    Scene scene;
    check::Random random(34);
    const fixtures::TriangleMesh mesh = fixtures::grid(6, 1, 0.05), other = fixtures::folded_pair(0.1);
    std::vector<Vec3> fold;
    for (const Vec3& x : mesh.vertices) {  // there, around a bend and back 0.006 above
        const double u = x.x() - 0.15;
        fold.emplace_back(u < 0.0 ? -u : u, x.y(), u < -0.02 ? 0.006 : u > 0.02 ? 0.0 : 0.003);
    }
    scene.add_cloth(mesh, fixtures::shaken(fold, random, 0.0005), {0});
    for (int i = 0; i < 14; ++i)
        scene.state.node_velocity[i] = Vec3(0, 0, i % 7 < 3 ? -1.5 : 0.5) + fixtures::random_vec3(random, 0.1);
    std::vector<Vec3> below;
    for (const Vec3& x : other.vertices) below.push_back(0.1 * x + Vec3(0.02, 0.025, -0.02));
    const fixtures::TriangleMesh small{below, other.triangles};
    scene.add_cloth(small, fixtures::shaken(below, random, 0.0005), {}, {0.2, 500.0, 100.0, 1e-3, 0.02});
    for (int i = 14; i < 18; ++i) scene.state.node_velocity[i] = Vec3(0.2, 0.1, 3.0);
    return scene;
}

Scene with_split(Scene scene) {
    scene.options.split = true;
    return scene;
}
Scene with_compliance(Scene scene, double compliance) {
    scene.options.compliance = compliance;
    return scene;
}

Scene in_second_order(Scene scene) {
    scene.options.integrator = Integrator::second_order;
    return scene;
}

}  // namespace

TEST(step_gradient_in_flight) { check_step_gradient(tumbling(), 0); }
TEST(step_gradient_of_a_landing) { check_step_gradient(tilted_landing(), 1); }
TEST(step_gradient_of_a_box_on_a_fixed_edge) { check_step_gradient(box_on_static_edge(), 1); }
TEST(step_gradient_of_a_collision_of_free_bodies) { check_step_gradient(free_collision(), 1); }
TEST(step_gradient_of_a_driven_push) { check_step_gradient(pushed_ball(), 2); }

TEST(step_gradient_of_a_hanging_sheet) { check_step_gradient(hanging_sheet(), 0); }
TEST(step_gradient_of_a_box_caught_by_a_sheet) { check_step_gradient(caught_box(), 1); }
TEST(step_gradient_of_a_landing_sheet) { check_step_gradient(landing_sheet(), 3); }
TEST(step_gradient_of_sheets_that_meet) { check_step_gradient(meeting_sheets(), 3); }
TEST(step_gradient_of_a_box_caught_softly) { check_step_gradient(with_compliance(caught_box(), 0.1), 1); }
TEST(step_gradient_of_sheets_that_meet_softly) { check_step_gradient(with_compliance(meeting_sheets(), 0.1), 3); }
TEST(step_gradient_of_a_landing_on_hard_contacts) {
    check_step_gradient(with_compliance(landing_sheet(), 0.0), 3, 10.0 * kDifferences);
}
TEST(step_gradient_of_a_box_caught_by_hard_contacts) {
    check_step_gradient(with_compliance(caught_box(), 0.0), 1, 10.0 * kDifferences);
}
TEST(step_gradient_of_split_coupling) {
    check_step_gradient(with_split(hanging_sheet()), 0);
    check_step_gradient(with_split(caught_box()), 1);
    check_step_gradient(with_split(landing_sheet()), 3);
    check_step_gradient(with_split(meeting_sheets()), 3);
}
TEST(step_gradient_of_split_coupling_with_soft_contacts) {
    check_step_gradient(with_compliance(with_split(caught_box()), 0.1), 1);
}
TEST(step_gradient_of_the_second_order_scheme_tumbling) { check_step_gradient(in_second_order(tumbling()), 0); }
TEST(step_gradient_of_the_second_order_scheme_tilted_landing) {
    check_step_gradient(in_second_order(tilted_landing()), 1);
}
TEST(step_gradient_of_the_second_order_scheme_free_collision) {
    check_step_gradient(in_second_order(free_collision()), 1);
}
TEST(step_gradient_of_the_second_order_scheme_pushed_ball) { check_step_gradient(in_second_order(pushed_ball()), 2); }
TEST(step_gradient_of_the_second_order_scheme_caught_box) { check_step_gradient(in_second_order(caught_box()), 1); }
TEST(step_gradient_of_the_second_order_scheme_hanging_sheet) {
    check_step_gradient(in_second_order(hanging_sheet()), 0);
}
TEST(step_gradient_of_the_second_order_scheme_landing_sheet) {
    check_step_gradient(in_second_order(landing_sheet()), 3);
}
TEST(step_gradient_of_the_second_order_scheme_meeting_sheets) {
    check_step_gradient(in_second_order(meeting_sheets()), 3);
}
TEST(step_gradient_of_the_second_order_scheme_hard) {
    check_step_gradient(in_second_order(with_compliance(caught_box(), 0.0)), 1, 10.0 * kDifferences);
}

}  // namespace test_step_gradient
