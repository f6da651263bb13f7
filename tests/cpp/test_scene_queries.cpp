#include "scene_queries.hpp"

#include <algorithm>

#include "contact/contact.hpp"
#include "fixtures.hpp"

using namespace diffsim;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kThickness = 1e-3;  // [m]

struct Scene {
    Model model;
    SceneState state;
    Parameters parameters;

    Scene() { model.thickness = kThickness; }
    int add(
        const fixtures::TriangleMesh& mesh, const Vec3& position, double margin = 0.5 * kThickness,
        BodyKind kind = BodyKind::dynamic) {
        model.bodies.push_back(fixtures::body(mesh, margin, kind));
        BodyState placed;
        placed.position = position;
        state.bodies.push_back(placed);
        parameters.mass.push_back(1.0);
        parameters.inertia.push_back(0.1 * Mat3::Identity());
        return model.body_count() - 1;
    }
    Pose pose(int i) const { return {quaternion_to_matrix(state.bodies[i].orientation), state.bodies[i].position}; }
    NearestObjects nearest() const { return nearest_objects(model, state); }
    SceneState separated() const { return separate_state(model, Options(), parameters, state); }
};

/// Over every pair of features of every pair of objects of which one can move.
NearestObjects brute_force(const Scene& scene) {
    const Model& model = scene.model;
    NearestObjects nearest;
    const auto consider = [&](const Contact& contact) {
        const Pose pose_b = contact.with_ground() ? Pose() : scene.pose(contact.object_b);
        const double bare =
            contact_geometry(model, contact, scene.pose(contact.object_a), pose_b, model.ground.height).distance;
        const double distance = bare - model.margin(contact.object_a) - model.margin(contact.object_b);
        if (distance < nearest.distance) nearest = {distance, contact.object_a, contact.object_b};
    };
    const auto is_static = [&](int i) { return model.bodies[i].kind == BodyKind::static_; };
    for (int a = 0; a < model.body_count(); ++a) {
        const CollisionMesh& mesh_a = model.bodies[a].mesh;
        const int vertices_a = static_cast<int>(mesh_a.vertices.size()),
                  patches_a = static_cast<int>(mesh_a.patches.size());
        if (model.ground.present && !is_static(a))
            for (int v = 0; v < vertices_a; ++v) consider({a, kGround, ContactType::vertex_patch, v, -1});
        for (int b = a + 1; b < model.body_count(); ++b) {
            if (is_static(a) && is_static(b)) continue;
            const CollisionMesh& mesh_b = model.bodies[b].mesh;
            const int vertices_b = static_cast<int>(mesh_b.vertices.size()),
                      patches_b = static_cast<int>(mesh_b.patches.size());
            for (int v = 0; v < vertices_a; ++v)
                for (int p = 0; p < patches_b; ++p) consider({a, b, ContactType::vertex_patch, v, p});
            for (int p = 0; p < patches_a; ++p)
                for (int v = 0; v < vertices_b; ++v) consider({a, b, ContactType::patch_vertex, p, v});
            for (int ea = 0; ea < static_cast<int>(mesh_a.edges.size()); ++ea)
                for (int eb = 0; eb < static_cast<int>(mesh_b.edges.size()); ++eb)
                    consider({a, b, ContactType::edge_edge, ea, eb});
        }
    }
    return nearest;
}

Scene random_scene(check::Random& random, int k) {
    Scene scene;
    const BodyKind kinds[] = {BodyKind::dynamic, BodyKind::static_, BodyKind::kinematic, BodyKind::static_};
    const double size = k % 3 == 0 ? 1.5 : 4.0;
    for (int i = 0; i < 6; ++i) {
        const fixtures::TriangleMesh point{{Vec3::Zero()}, {}}, rod{{Vec3(-0.4, 0, 0), Vec3(0.4, 0, 0)}, {}};
        const fixtures::TriangleMesh meshes[] = {
            fixtures::box(Vec3(0.2, 0.3, 0.1)), fixtures::tetrahedron(0.3), point, rod};
        scene.add(meshes[(i + k) % 4], random_vec3(random, size), random.uniform(0.0, 0.2), kinds[i % 4]);
        scene.state.bodies.back().orientation = exp_quaternion(random_vec3(random, 2.0));
    }
    if (k % 2 == 0) scene.model.ground = {true, -size, 0.05};
    return scene;
}

}  // namespace

TEST(nearest_objects_are_those_of_brute_force) {
    check::Random random(1);
    int apart = 0, grounded = 0;
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        const Scene scene = random_scene(random, k);
        const NearestObjects found = scene.nearest(), expected = brute_force(scene);
        CHECK_NEAR(found.distance, expected.distance, 1e-13);  // lengths of order 1, another frame
        CHECK(found.a == expected.a);
        CHECK(found.b == expected.b);
        apart += found.distance > 0.05 ? 1 : 0;
        grounded += found.b == kGround ? 1 : 0;
    }
    CHECK(apart >= 5);
    CHECK(grounded >= 2);
}

TEST(nearest_objects_far_from_the_origin) {
    Scene scene;
    const Vec3 far(1e6, -1e6, 1e6);
    scene.add(fixtures::box(Vec3(0.5, 0.5, 0.5)), far);
    scene.add(fixtures::box(Vec3(0.5, 0.5, 0.5)), far + Vec3(1.25, 0, 0));
    CHECK_NEAR(scene.nearest().distance, 0.25 - kThickness, 1e-9);  // 1e6 · eps
}

TEST(alone_nothing_is_near) {
    Scene scene;
    scene.add(fixtures::tetrahedron(), Vec3::Zero());
    CHECK(scene.nearest().distance == kInfinity);
    CHECK(scene.nearest().a == kNobody);
    scene.add(fixtures::tetrahedron(), Vec3(9, 0, 0), 0.0, BodyKind::static_);
    CHECK(scene.nearest().distance < 9.0);
    scene.model.bodies[0].kind = BodyKind::static_;
    CHECK(scene.nearest().distance == kInfinity);
}

TEST(separation_moves_touching_boxes_apart_and_nothing_else) {
    for (const double gap : {0.0, 1e-12, 2e-4, 0.9e-3}) {
        NOTE(gap);
        Scene scene;
        const Vec3 half(0.1, 0.1, 0.1);
        scene.model.ground = {true, 0.0, 0.5 * kThickness};
        scene.add(fixtures::box(half), Vec3(0, 0, 0.1 + gap));
        scene.add(fixtures::box(half), Vec3(0.02, 0.01, 0.3 + 2.0 * gap));
        scene.add(fixtures::box(half), Vec3(2, 0, 0.5));
        CHECK(scene.nearest().distance < 0.0);
        const SceneState start = scene.state;
        scene.state = scene.separated();
        CHECK(scene.nearest().distance >= -1e-6 * kThickness);
        for (int i = 0; i < 2; ++i) {
            CHECK((scene.state.bodies[i].position - start.bodies[i].position).norm() > 1e-5);
            CHECK((scene.state.bodies[i].position - start.bodies[i].position).norm() < 5.0 * kThickness);
        }
        CHECK(scene.state.bodies[2].position == start.bodies[2].position);
        CHECK(scene.state.bodies[2].orientation == start.bodies[2].orientation);
        StepWorkspace workspace;
        StepInfo info;
        SceneControl control;
        control.bodies.resize(3);
        step(scene.model, Options(), scene.parameters, scene.state, control, workspace, info, nullptr);
        CHECK(info.converged);
    }
}

TEST(separation_respects_what_does_not_yield) {
    Scene scene;
    scene.add(fixtures::box(Vec3(0.1, 0.1, 0.1)), Vec3(0, 0, 0.2));
    scene.add(fixtures::box(Vec3(0.3, 0.3, 0.1)), Vec3(0, 0, 0), 0.5 * kThickness, BodyKind::static_);
    const SceneState moved = scene.separated();
    CHECK(moved.bodies[1].position == scene.state.bodies[1].position);
    CHECK_NEAR(moved.bodies[0].position.z(), 0.2 + kThickness, 2e-2 * kThickness);
    CHECK_NEAR(moved.bodies[0].position.head<2>(), Eigen::Vector2d::Zero(), 1e-9);
}

TEST(separation_leaves_what_is_apart_alone) {
    Scene scene;
    scene.add(fixtures::box(Vec3(0.1, 0.1, 0.1)), Vec3(0, 0, 0));
    scene.add(fixtures::box(Vec3(0.1, 0.1, 0.1)), Vec3(0.2 + 1.01 * kThickness, 0, 0));
    const SceneState moved = scene.separated();
    for (int i = 0; i < 2; ++i) CHECK(moved.bodies[i].position == scene.state.bodies[i].position);
}
