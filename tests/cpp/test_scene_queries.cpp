#include "scene_queries.hpp"

#include <algorithm>

#include "cloth_fixtures.hpp"
#include "zone/zone_contacts.hpp"

namespace test_scene_queries {

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
    /// A cloth, whose nodes are as at rest.
    int add_cloth(const fixtures::TriangleMesh& mesh, double margin = 0.5 * kThickness) {
        Cloth cloth = fixtures::cloth(mesh, margin);
        cloth.first_node = model.node_count();
        model.cloths.push_back(cloth);
        state.node_position.insert(state.node_position.end(), cloth.rest.begin(), cloth.rest.end());
        state.node_velocity.resize(state.node_position.size(), Vec3::Zero());
        parameters.cloths.push_back({0.2, 1000.0, 300.0, 1e-4, 0.0});
        return model.body_count() + model.cloth_count() - 1;  // no body may follow
    }
    /// The nodes of a cloth, by its object.
    Vec3* nodes(int object) { return state.node_position.data() + model.cloth_of(object).first_node; }
    void place(int object, const std::vector<Vec3>& x) { std::copy(x.begin(), x.end(), nodes(object)); }
    CrossingObjects crossing() const { return find_crossing(model, state); }
    bool crosses(int a, int b) const {
        const CrossingObjects found = crossing();
        return found.a == a && found.b == b;
    }
    Pose pose(int i) const { return {quaternion_to_matrix(state.bodies[i].orientation), state.bodies[i].position}; }
    NearestObjects nearest() const { return nearest_objects(model, state); }
    SceneState separated() const { return separate_state(model, Options(), parameters, state); }
};

/// Over every pair of features of every pair of objects that contact can move, and of every cloth.
NearestObjects brute_force(const Scene& scene) {
    const Model& model = scene.model;
    NearestObjects nearest;
    const int count = model.body_count() + model.cloth_count();
    std::vector<Pose> poses;
    for (int i = 0; i < model.body_count(); ++i) poses.push_back(scene.pose(i));
    const auto surface = [&](int i) {
        if (model.is_cloth(i))
            return Surface{
                &model.cloth_of(i).surface, nullptr, scene.state.node_position.data() + model.cloth_of(i).first_node};
        return Surface{&model.bodies[i].mesh, &poses[i], nullptr};
    };
    const auto consider = [&](const Contact& contact) {
        const Surface b = contact.with_ground() ? Surface{} : surface(contact.object_b);
        const double bare = ContactGeometry(contact, surface(contact.object_a), b, model.ground.height).distance;
        const double distance = bare - contact_margins(model, contact);
        if (distance < nearest.distance) nearest = {distance, contact.object_a, contact.object_b};
    };
    const auto moves = [&](int i) { return model.is_cloth(i) || model.bodies[i].is_dynamic(); };
    const auto share = [](const CollisionMesh& mesh, const Contact& contact) {
        for (int i : feature_vertices(mesh, contact.on_a()))
            for (int j : feature_vertices(mesh, contact.on_b()))
                if (i >= 0 && i == j) return true;
        return false;
    };
    for (int a = 0; a < count; ++a) {
        const CollisionMesh& mesh_a = *surface(a).mesh;
        const int vertices_a = static_cast<int>(mesh_a.vertices.size()),
                  patches_a = static_cast<int>(mesh_a.patches.size());
        if (model.ground.present && moves(a))
            for (int v = 0; v < vertices_a; ++v) consider({a, kGround, ContactType::vertex_patch, v, -1});
        for (int b = a; b < count; ++b) {
            if (!moves(a) && !moves(b)) continue;
            if (a == b && !model.is_cloth(a)) continue;
            const CollisionMesh& mesh_b = *surface(b).mesh;
            const int vertices_b = static_cast<int>(mesh_b.vertices.size()),
                      patches_b = static_cast<int>(mesh_b.patches.size());
            const auto consider_pair = [&](const Contact& contact) {
                if (a != b || !share(mesh_a, contact)) consider(contact);
            };
            for (int v = 0; v < vertices_a; ++v)
                for (int p = 0; p < patches_b; ++p) consider_pair({a, b, ContactType::vertex_patch, v, p});
            for (int p = 0; p < patches_a; ++p)
                for (int v = 0; v < vertices_b; ++v) consider_pair({a, b, ContactType::patch_vertex, p, v});
            for (int ea = 0; ea < static_cast<int>(mesh_a.edges.size()); ++ea)
                for (int eb = 0; eb < static_cast<int>(mesh_b.edges.size()); ++eb)
                    consider_pair({a, b, ContactType::edge_edge, ea, eb});
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

TEST(nearest_objects_with_cloth_are_those_of_brute_force) {
    check::Random random(2);
    int pairs[4] = {0, 0, 0, 0};  // with a body, with the ground, of two cloths, of one
    for (int k = 0; k < 80; ++k) {
        NOTE(k);
        Scene scene;
        const double size = k % 2 == 0 ? 1.5 : 4.0;
        const BodyKind kinds[] = {BodyKind::kinematic, BodyKind::static_, BodyKind::dynamic};
        for (int i = 0; i < k % 4; ++i) {
            scene.add(fixtures::box(Vec3(0.2, 0.3, 0.1)), random_vec3(random, size), 0.02, kinds[i]);
            scene.state.bodies.back().orientation = exp_quaternion(random_vec3(random, 2.0));
        }
        if (k % 3 == 0) scene.model.ground = {true, -1.5, 0.05};
        for (int i = 0; i < 2; ++i) {
            // Thick for its triangles, which are nearer to each other than that, or thin.
            const int cloth = scene.add_cloth(fixtures::grid(5, 2, 0.3), i == k % 2 ? 0.4 : 0.01);
            const Vec3 place = random_vec3(random, size);
            const std::vector<Vec3>& rest = scene.model.cloth_of(cloth).rest;
            scene.place(
                cloth, fixtures::moved(
                           fixtures::shaken(fixtures::rolled(rest, 0.3, random.uniform(0.1, 0.4)), random, 0.02),
                           random_rotation(random), place));
        }
        const NearestObjects found = scene.nearest(), expected = brute_force(scene);
        CHECK_NEAR(found.distance, expected.distance, 1e-13);
        CHECK(found.a == expected.a);
        CHECK(found.b == expected.b);
        const int bodies = scene.model.body_count();
        ++pairs[found.b == kGround ? 1 : found.a < bodies ? 0 : found.a < found.b ? 2 : 3];
    }
    for (const int count : pairs) CHECK(count >= 2);
}

TEST(a_cloth_alone_is_as_far_from_itself_as_its_triangles_are_large) {
    Scene scene;
    const int cloth = scene.add_cloth(fixtures::grid(4, 4, 0.1), 0.01);
    CHECK(scene.nearest().a == cloth);
    CHECK(scene.nearest().b == cloth);
    CHECK_NEAR(scene.nearest().distance, 0.1 / std::sqrt(2.0) - 0.02, 1e-12);
    for (int i = 0; i < 25; ++i) scene.nodes(cloth)[i] += Vec3(1e6, -1e6, 1e6);
    CHECK_NEAR(scene.nearest().distance, 0.1 / std::sqrt(2.0) - 0.02, 1e-9);  // 1e6 · eps
    Scene single;
    single.add_cloth({{{0, 0, 0}, {1, 0, 0}, {0, 1, 0}}, {{0, 1, 2}}});
    CHECK(single.nearest().distance == kInfinity);
    Scene thick;  // than which its triangles are smaller: at rest it does not touch itself
    thick.add_cloth(fixtures::grid(4, 4, 0.1), 0.2);
    CHECK_NEAR(thick.nearest().distance, 0.05 / std::sqrt(2.0), 1e-12);
}

TEST(objects_that_no_contact_moves_are_not_near) {
    Scene scene;
    scene.model.ground = {true, 0.0, 0.0};
    scene.add(fixtures::box(Vec3(0.1, 0.1, 0.1)), Vec3(0, 0, 0.05), 0.0, BodyKind::kinematic);
    scene.add(fixtures::box(Vec3(0.1, 0.1, 0.1)), Vec3(0.1, 0, 0.05), 0.0, BodyKind::static_);
    scene.add(fixtures::box(Vec3(0.1, 0.1, 0.1)), Vec3(0, 0.1, 0.05), 0.0, BodyKind::kinematic);
    CHECK(scene.nearest().distance == kInfinity);
    CHECK(scene.nearest().a == kNobody);
    CHECK(scene.crossing().a == kNobody);
}

TEST(crossing_cloth_is_found) {
    Scene scene;
    scene.add(fixtures::box(Vec3(0.2, 0.2, 0.05)), Vec3(0, 0, 0), 0.0, BodyKind::static_);
    scene.add(fixtures::box(Vec3(0.2, 0.2, 0.05)), Vec3(0, 0, 1), 0.0, BodyKind::kinematic);
    scene.add({{Vec3(-0.2, 0, 0), Vec3(0.2, 0, 0)}, {}}, Vec3(0, 0, 2));
    const int first = scene.add_cloth(fixtures::grid(6, 6, 0.1)), second = scene.add_cloth(fixtures::grid(3, 3, 0.1));
    const std::vector<Vec3> large = scene.model.cloth_of(first).rest, small = scene.model.cloth_of(second).rest;
    const Mat3 upright = exp_rotation(Vec3(1.3, 0.2, 0.1));
    const auto clear = [&] {
        scene.place(first, fixtures::moved(large, Mat3::Identity(), Vec3(5, 0, 0)));
        scene.place(second, fixtures::moved(small, Mat3::Identity(), Vec3(-5, 0, 0)));
        scene.state.bodies[2].position = Vec3(0, 0, 2);
    };
    clear();
    CHECK(scene.crossing().a == kNobody);
    scene.place(first, fixtures::moved(large, upright, Vec3(-0.31, -0.12, -0.29)));
    CHECK(scene.crosses(0, first));
    scene.place(first, fixtures::moved(large, Mat3::Identity(), Vec3(-0.31, -0.32, 0.96)));
    CHECK(scene.crosses(1, first));
    scene.place(first, fixtures::moved(large, Mat3::Identity(), Vec3(-0.31, -0.32, 0.94)));  // just below
    CHECK(scene.crossing().a == kNobody);
    scene.place(first, fixtures::moved(large, Mat3::Identity(), Vec3(-0.31, -0.32, 0.5)));
    scene.place(second, fixtures::moved(small, upright, Vec3(-0.1, -0.11, 0.41)));
    CHECK(scene.crosses(first, second));
    clear();
    // The axis of a capsule through it.
    scene.place(second, fixtures::moved(small, exp_rotation(Vec3(0.1, 1.3, 0)), Vec3(0.03, -0.11, 2.14)));
    CHECK(scene.crosses(2, second));
    clear();
    std::vector<Vec3> roll = fixtures::rolled(large, 0.05, 0.1);
    scene.place(first, fixtures::moved(roll, upright, Vec3(5, 0, 0)));
    CHECK(scene.crossing().a == kNobody);
    roll[24].x() *= -3.0;  // from the middle of the sheet through the roll
    roll[24].z() *= -3.0;
    scene.place(first, fixtures::moved(roll, upright, Vec3(5, 0, 0)));
    CHECK(scene.crosses(first, first));
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

}  // namespace test_scene_queries
