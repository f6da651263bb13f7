#include "step.hpp"

#include <Eigen/LU>
#include <functional>
#include <stdexcept>

#include "fixtures.hpp"

using namespace diffsim;

namespace {

constexpr double kDt = 0.01;         // [s]
constexpr double kThickness = 1e-3;  // [m]
constexpr double kStep = 1e-6;       // of positions, turns and speeds times dt [m or rad]
// Of a gradient's norm: solutions are good to about 1e-13 m, differenced over kStep; velocities divide both by dt.
constexpr double kDifferences = 1e-6;

/// Everything a step depends on.
struct Scene {
    Model model;
    Options options;
    Parameters parameters;
    SceneState state;
    SceneControl control;

    Scene() {
        options.dt = kDt;
        model.thickness = kThickness;
        parameters.gravity = Vec3(0.2, 0.1, -9.81);
    }
    int add(Body body, const Vec3& position, const Vec3& turn, double mass, const Mat3& inertia) {
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
    int add_box(
        const Vec3& half, const Vec3& position, const Vec3& turn = Vec3::Zero(), BodyKind kind = BodyKind::dynamic,
        double mass = 2.0) {
        return add(
            fixtures::body(fixtures::box(half), 0.5 * kThickness, kind), position, turn, mass,
            fixtures::box_inertia(half, mass));
    }
    int add_ball(double radius, const Vec3& position, double mass) {
        Body ball;
        ball.margin = radius;
        ball.mesh = build_collision_mesh({Vec3::Zero()}, {});
        return add(ball, position, Vec3::Zero(), mass, 0.4 * mass * radius * radius * Mat3::Identity());
    }
    void add_ground() { model.ground = {true, 0.0, 0.5 * kThickness}; }

    SceneState step(StepInfo& info, StepRecord* record = nullptr) const {
        StepWorkspace workspace;
        return diffsim::step(model, options, parameters, state, control, workspace, info, record);
    }
    SceneState step() const {
        StepInfo info;
        const SceneState result = step(info);
        CHECK(info.converged);
        return result;
    }
};

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
    SceneState reference;

    Loss(const Scene& scene, std::uint64_t seed) : reference(scene.step()) {
        check::Random random(seed);
        const auto vec3 = [&](double size) { return fixtures::random_vec3(random, size); };
        for (int i = 0; i < scene.model.body_count(); ++i)
            weights.push_back({vec3(1.0), vec3(1.0), vec3(kDt), vec3(kDt)});
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
    SceneControlGradient control;
    control.bodies.resize(count);
    ParameterGradient parameters;
    parameters.mass.assign(count, 0.0);
    parameters.inertia.assign(count, Mat3::Zero());
    StepWorkspace workspace;
    step_backward(
        scene.model, scene.options, scene.parameters, scene.control, record, workspace, gradient, control, parameters);

    std::vector<Input> inputs = {
        {"gravity", 3, 1e-3, [](Scene& s, const VectorX& x) { s.parameters.gravity += x; }, parameters.gravity}};
    for (int i = 0; i < static_cast<int>(count); ++i)
        for (Input& input : inputs_of(i, scene.model.bodies[i].kind, gradient.bodies[i], control.bodies[i], parameters))
            inputs.push_back(std::move(input));
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
    CHECK(gradient.bodies[0].position.norm() > 1e-2);
    CHECK(parameters.gravity.norm() > 1e-6);
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

Scene box_on_static_edge() {
    Scene scene;
    scene.add_box(Vec3(0.1, 0.1, 0.1), Vec3(0.1, 0.02, 0.155), Vec3(0.3, 0.7, 0.1));
    scene.add_box(Vec3(0.15, 0.3, 0.05), Vec3(0, 0, 0), Vec3(0, 0, 0.2), BodyKind::static_);
    scene.state.bodies[0].velocity.z() = -8.0;
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

}  // namespace

TEST(step_gradient_in_flight) { check_step_gradient(tumbling(), 0); }
TEST(step_gradient_of_a_landing) { check_step_gradient(tilted_landing(), 1); }
TEST(step_gradient_of_a_box_on_a_fixed_edge) { check_step_gradient(box_on_static_edge(), 1); }
TEST(step_gradient_of_a_collision_of_free_bodies) { check_step_gradient(free_collision(), 1); }
TEST(step_gradient_of_a_driven_push) { check_step_gradient(pushed_ball(), 2); }

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
