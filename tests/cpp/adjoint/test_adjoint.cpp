#include "adjoint/adjoint.hpp"
#include "adjoint/linearised_zone.hpp"

#include <Eigen/LU>

#include "cloth_fixtures.hpp"
#include "solve/zone_solver.hpp"

namespace test_adjoint {

using namespace diffsim;
using fixtures::dense;
using fixtures::flatten;
using fixtures::unflatten;

namespace {

constexpr double kThickness = 1e-3;  // [m]
constexpr double kDt = 0.01;         // [s]
// Two ways to solve the same linear system, of condition 1 / compliance times some.
constexpr double kSameSystem = 1e-9;
// Differences over kStep of solutions that are good to about 1e-13 m.
constexpr double kDifferences = 1e-6;
constexpr double kStep = 2e-6;

/// The nodes of a cloth.
struct Sheet {
    std::vector<Vec3> start, target;
    std::vector<double> mass;
};

/// Append a contact like this one, of another set.
void append(ContactSet& set, const ZoneContact& contact) {
    set.append(contact.contact, {contact.a, contact.cloth_a}, {contact.b, contact.cloth_b}, true);
    set.laws.push_back(contact.law);
    set.pairs.back().block = contact.block;
}

/// Bodies and cloths at rest or landing, and how they are solved.
struct Scene {
    Model model;
    std::vector<Sheet> sheets;
    std::vector<ClothParameters> materials;
    std::vector<ZoneBody> bodies;
    PassiveBodies passive;
    double compliance = 1e-4;

    int add(const Vec3& half, const Pose& start, double mass) {
        const int id = model.body_count();
        model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness));
        bodies.push_back(fixtures::zone_body(id, start, mass, fixtures::box_inertia(half, mass)));
        bodies.back().target.tail<3>() = kDt * kDt * Vec3(0.3, -0.2, -9.81) * 30.0;  // pressed and pushed sideways
        bodies.back().target.head<3>() = 1e-3 * Vec3(0.4, 0.3, 0.2);
        return id;
    }
    /// A body that does not yield.
    void add_static(const Vec3& half, const Pose& start) {
        const int id = model.body_count();
        model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness, BodyKind::static_));
        passive.bodies.push_back({id, start, Vec6::Zero()});
        plant_tree();
    }
    void plant_tree() {
        std::vector<Box> boxes;
        for (const PassiveBody& body : passive.bodies)
            boxes.push_back(swept_box({&model.bodies[body.id].mesh, {body.start, body.start}, 0.1}));
        passive.tree = build_box_tree(boxes);
    }
    void add_sheet(const fixtures::TriangleMesh& rest, const std::vector<Vec3>& start, const std::vector<int>& pinned) {
        Cloth cloth = fixtures::cloth(rest, 0.5 * kThickness);
        cloth.first_node = model.node_count();
        for (int node : pinned) cloth.pinned[node] = 1;
        materials.push_back({0.5, 800.0, 200.0, 1e-3, 0.005});
        sheets.push_back({start, {}, {}});
        for (std::size_t k = 0; k < start.size(); ++k) {
            sheets.back().target.push_back(kDt * kDt * Vec3(0.3, -0.2, -9.81) * 10.0);
            sheets.back().mass.push_back(materials.back().density * cloth.node_area[k]);
        }
        for (int node : pinned) sheets.back().target[node].setZero();
        model.cloths.push_back(cloth);
    }
    Zone zone() const {
        Zone result;
        make_zone(result, model, materials, compliance, Vec3::Zero());
        result.bodies = bodies;
        result.dynamic_count = static_cast<int>(bodies.size());
        for (int i = 0; i < model.cloth_count(); ++i) {
            fixtures::add_zone_cloth(result, i, sheets[i].start, materials[i], kDt);
            for (std::size_t k = 0; k < sheets[i].start.size(); ++k) {
                ZoneNode& node = result.nodes[result.cloths.back().first_node + static_cast<int>(k)];
                node.target = sheets[i].target[k];
                node.mass = sheets[i].mass[k];
            }
        }
        return result;
    }
    /// The zone at its solution, with its active contacts only.
    Zone solve(ZonePoint& point) const {
        Zone result = zone();
        ZoneWorkspace workspace;
        std::vector<Box> swept;
        const ZoneResult outcome = solve_zone(result, passive, ZoneOptions(), workspace, swept);
        CHECK(outcome.status == StepStatus::converged);
        ContactSet active;
        for (const ActiveContact& a : workspace.point.active) append(active, result.contacts[a.index]);
        active.blocks = result.contacts.blocks;
        active.vertices = result.contacts.vertices;
        result.contacts = active;
        point.y = workspace.point.y;
        evaluate(result, point);
        return result;
    }
    VectorX solution() const {
        ZonePoint point;
        const Zone solved = solve(point);
        point.y.bodies.resize(static_cast<std::size_t>(solved.dynamic_count));
        return flatten(point.y);
    }
};

/// Two boxes on the ground, a box that bridges them, and one on top: many more contact rows
/// than they can be independent.
Scene stack() {
    Scene scene;
    scene.model.thickness = kThickness;
    scene.model.ground = {true, 0.0, 0.5 * kThickness};
    const double gap = 0.97 * kThickness;  // pressed together a little
    const Mat3 turned = exp_rotation(Vec3(0, 0, 0.2));
    scene.add(Vec3(0.1, 0.1, 0.1), {Mat3::Identity(), Vec3(-0.25, 0.02, 0.1 + gap)}, 8.0);
    scene.add(Vec3(0.1, 0.1, 0.1), {turned, Vec3(0.25, 0, 0.1 + gap)}, 6.0);
    scene.add(Vec3(0.5, 0.3, 0.05), {Mat3::Identity(), Vec3(0, 0, 0.25 + 2.0 * gap)}, 20.0);
    scene.add(Vec3(0.2, 0.2, 0.1), {turned, Vec3(0.05, 0.01, 0.4 + 3.0 * gap)}, 10.0);
    return scene;
}

/// A tilted box that comes down on the ground and against a block that stands there.
Scene landing() {
    Scene scene;
    scene.model.thickness = kThickness;
    scene.model.ground = {true, 0.0, 0.5 * kThickness};
    scene.add_static(Vec3(0.1, 0.5, 0.3), {exp_rotation(Vec3(0, 0, 0.1)), Vec3(0.37, 0, 0.3)});
    const Mat3 R = exp_rotation(Vec3(0.1, 0.2, 0.1));
    scene.add(Vec3(0.2, 0.15, 0.1), {R, Vec3(0, 0, 0.17)}, 5.0);
    scene.bodies[0].target << 0.05, -0.3, 0.1, 0.08, 0.01, -0.05;
    return scene;
}

/// A box that lands on a sheet held at its corners, above a fixed block and next to a small sheet on the
/// ground, of which it hits the edge.
Scene caught() {
    Scene scene;
    scene.model.thickness = kThickness;
    scene.model.ground = {true, -0.1, 0.5 * kThickness};
    scene.add_static(Vec3(0.05, 0.05, 0.03), {exp_rotation(Vec3(0.1, 0.2, 0.1)), Vec3(0.2, 0.2, -0.05)});
    scene.add(Vec3(0.08, 0.06, 0.03), {exp_rotation(Vec3(0.1, -0.15, 0.3)), Vec3(0.12, 0.15, 0.05)}, 0.4);
    scene.bodies[0].target << 0.05, -0.1, 0.1, 0.005, 0.003, -0.04;
    check::Random random(11);
    const fixtures::TriangleMesh large = fixtures::grid(3, 3, 0.1), small = fixtures::grid(1, 1, 0.1);
    scene.add_sheet(large, fixtures::shaken(large.vertices, random, 0.002), {0, 3, 12});
    scene.sheets[0].target[3] = Vec3(0.002, 0.001, 0.003);  // driven
    scene.add_sheet(
        small, fixtures::moved(small.vertices, exp_rotation(Vec3(0.05, 0.03, 0.4)), Vec3(0.03, 0.06, -0.005)), {});
    for (Vec3& target : scene.sheets[1].target) target = Vec3(0.003, 0.002, 0.02);
    return scene;
}

Coordinates random_upstream(const Zone& zone, std::uint64_t seed) {
    return unflatten(check::Random(seed).vector(6 * zone.dynamic_count + 3 * zone.node_count()), zone.dynamic_count);
}

/// Nothing at pinned nodes, which do not answer.
Coordinates without_pinned(const Zone& zone, Coordinates y) {
    for (int i = 0; i < zone.node_count(); ++i)
        if (zone.nodes[i].pinned) y.nodes[i].setZero();
    return y;
}

/// The coordinates of bodies and of nodes that are not pinned.
VectorX free_part(const Zone& zone, const VectorX& y) {
    const Eigen::Index bodies = 6 * zone.dynamic_count;
    std::vector<double> kept(y.data(), y.data() + bodies);
    for (int i = 0; i < zone.node_count(); ++i)
        if (!zone.nodes[i].pinned) kept.insert(kept.end(), y.data() + bodies + 3 * i, y.data() + bodies + 3 * i + 3);
    return Eigen::Map<const VectorX>(kept.data(), static_cast<Eigen::Index>(kept.size()));
}

VectorX multiplier(const Zone& zone, const ZonePoint& point, const Coordinates& upstream, AdjointMode mode) {
    AdjointWorkspace workspace;
    return flatten(zone_adjoint(zone, point, {}, upstream, mode, GradientNeeds{}, workspace).multiplier);
}

void check_same_system(const Zone& zone, const ZonePoint& point) {
    for (const std::uint64_t seed : {1, 2, 3}) {
        const Coordinates upstream = random_upstream(zone, seed);
        const VectorX by_lu = multiplier(zone, point, upstream, AdjointMode::dense);
        const VectorX by_qr = multiplier(zone, point, upstream, AdjointMode::qr);
        BlockSystem system;
        ZoneDerivatives derivatives;
        system.set_pattern(base_pattern(zone));
        differentiate(zone, point, Curvature::dropped, derivatives, &system);
        const VectorX direct = dense(system).ldlt().solve(flatten(without_pinned(zone, upstream)));
        CHECK(by_lu.norm() > 0.0);
        CHECK_NEAR(by_qr, by_lu, kSameSystem * by_lu.norm());
        CHECK_NEAR(direct, by_lu, kSameSystem * by_lu.norm());
        const LinearisedZone linear = linearise(zone, point);
        const MatrixX condensed = linear.inertia + linear.J.transpose() * linear.stiffness.asDiagonal() * linear.J;
        CHECK_NEAR(
            free_part(zone, direct), condensed.llt().solve(free_part(zone, flatten(upstream))),
            kSameSystem * by_lu.norm());
    }
}

}  // namespace

TEST(dense_and_qr_solve_the_same_system_on_redundant_rows) {
    ZonePoint point;
    const Scene scene = stack();
    Zone zone = scene.solve(point);
    CHECK(zone.dynamic_count == 4);
    CHECK(point.active.size() >= 20);  // of 24 unknowns, 8 of them free to slide or turn on the spot
    check_same_system(zone, point);

    // Every row many times over.
    const ContactSet once = zone.contacts;
    for (int copy = 0; copy < 4; ++copy)
        for (const ZoneContact& contact : once) append(zone.contacts, contact);
    evaluate(zone, point);
    CHECK(point.active.size() >= 100);
    check_same_system(zone, point);
}

TEST(dense_and_qr_solve_the_same_system_on_turned_coordinates) {
    ZonePoint point;
    const Scene scene = landing();
    const Zone zone = scene.solve(point);
    CHECK(point.active.size() >= 2);
    CHECK(point.y.bodies[0].head<3>().norm() > 0.05);
    check_same_system(zone, point);
}

// What contacts do to the place gradient is stiffness J z, and J z is smaller than z by the compliance.
TEST(stiff_contacts_cost_dense_and_qr_no_digits) {
    for (const double compliance : {1e-4, 1e-6, 1e-8}) {
        NOTE(compliance);
        Scene scene = stack();
        scene.compliance = compliance;
        ZonePoint point;
        const Zone zone = scene.solve(point);
        CHECK(point.active.size() >= 16);
        const Coordinates upstream = random_upstream(zone, 4);
        const auto pose_gradient = [&](AdjointMode mode) {
            AdjointWorkspace workspace;
            return flatten(zone_adjoint(zone, point, {}, upstream, mode, GradientNeeds{}, workspace).pose_gradient);
        };
        const VectorX by_lu = pose_gradient(AdjointMode::dense), by_qr = pose_gradient(AdjointMode::qr);
        CHECK(by_lu.norm() > 0.1);
        CHECK_NEAR(by_qr, by_lu, 1e-12 * by_lu.norm());
    }
}

TEST(dense_and_qr_do_without_contacts) {
    ZonePoint point;
    const Scene scene = stack();
    Zone zone = scene.solve(point);
    zone.contacts.clear();
    evaluate(zone, point);
    CHECK(point.active.empty());
    check_same_system(zone, point);
}

TEST(dense_and_qr_solve_the_same_system_with_cloth) {
    for (const double compliance : {1e-4, 1e-2}) {
        NOTE(compliance);
        Scene scene = caught();
        scene.compliance = compliance;
        ZonePoint point;
        const Zone zone = scene.solve(point);
        CHECK(point.active.size() >= 4);
        check_same_system(zone, point);
    }
}

TEST(all_modes_agree_on_hard_contacts_with_cloth_as_far_as_they_are_straight) {
    Scene scene = caught();
    scene.compliance = 0.0;
    ZonePoint point;
    const Zone zone = scene.solve(point);
    CHECK(point.active.size() >= 4);
    const Coordinates upstream = random_upstream(zone, 8);
    const VectorX by_lu = multiplier(zone, point, upstream, AdjointMode::dense);
    const VectorX by_qr = multiplier(zone, point, upstream, AdjointMode::qr);
    CHECK(by_lu.norm() > 0.0);
    CHECK_NEAR(by_qr, by_lu, 1e-8 * by_lu.norm());
    // J z = 0: no contact opens or closes along z.
    AdjointWorkspace workspace;
    const Coordinates z =
        zone_adjoint(zone, point, {}, upstream, AdjointMode::dense, GradientNeeds{}, workspace).multiplier;
    const auto distances_at = [&](double s) {
        ZonePoint moved;
        moved.y = point.y;
        for (std::size_t i = 0; i < z.bodies.size(); ++i) moved.y.bodies[i] += s * z.bodies[i];
        for (std::size_t i = 0; i < z.nodes.size(); ++i) moved.y.nodes[i] += s * z.nodes[i];
        evaluate(zone, moved);
        return VectorX(
            Eigen::Map<const VectorX>(moved.distances.data(), static_cast<Eigen::Index>(moved.distances.size())));
    };
    const double step = 1e-7 / by_lu.cwiseAbs().maxCoeff();
    const VectorX rate = (distances_at(step) - distances_at(-step)) / (2.0 * step);
    CHECK(rate.cwiseAbs().maxCoeff() <= 1e-6 * by_lu.norm());
}

TEST(exact_adjoint_with_cloth_agrees_with_differences_of_the_solve) {
    for (const double compliance : {1e-4, 5e-2}) {
        NOTE(compliance);
        Scene scene = caught();
        scene.compliance = compliance;
        ZonePoint point;
        const Zone zone = scene.solve(point);
        CHECK(point.active.size() >= 4);
        const Coordinates upstream = random_upstream(zone, 9);
        AdjointWorkspace workspace;
        const ZoneAdjoint adjoint =
            zone_adjoint(zone, point, {}, upstream, AdjointMode::exact, GradientNeeds{}, workspace);
        // What the loss sees of pinned nodes is their own motion, which is not the adjoint's part.
        const VectorX weights = flatten(without_pinned(zone, upstream));
        const auto loss = [&](const Scene& changed) { return weights.dot(changed.solution()); };
        const auto numeric = [&](double step, const auto& change) {
            const auto at = [&](const VectorX& x) {
                Scene changed = scene;
                change(changed, x[0]);
                return loss(changed);
            };
            return fixtures::numeric_gradient(at, VectorX::Zero(1), step)[0];
        };
        // Of vectors one direction each: a solve takes long.
        check::Random random(10);
        const Vec6 twist = random.vector(6).normalized();
        const Vec3 shift = random.vector(3).normalized();
        Vec6 by_target;
        const Vec6& z = adjoint.multiplier.bodies[0];
        by_target << scene.bodies[0].inertia * z.head<3>(), scene.bodies[0].mass * z.tail<3>();
        CHECK(by_target.norm() > 1e-2);
        CHECK_NEAR(
            by_target.dot(twist), numeric(kStep, [&](Scene& s, double x) { s.bodies[0].target += x * twist; }),
            kDifferences);

        const double scale = flatten(adjoint.pose_gradient).norm();
        CHECK(scale > 0.1);
        double by_stiffness = 0.0;
        for (std::size_t sheet = 0; sheet < 2; ++sheet) {
            NOTE(sheet);
            const int first = zone.cloths[sheet].first_node;
            // A driven and a free one; a corner.
            for (const std::size_t k : sheet == 0 ? std::vector<std::size_t>{3, 5} : std::vector<std::size_t>{2}) {
                NOTE(k);
                const int i = first + static_cast<int>(k);
                const ZoneNode& node = zone.nodes[i];
                const Vec3& z_node = adjoint.multiplier.nodes[i];
                const Vec3 &place = adjoint.pose_gradient.nodes[i], &start = adjoint.start_gradient[i];
                const Vec3 by_node_target = node.pinned ? place : Vec3(node.mass * z_node);
                const double targeted =
                    numeric(kStep, [&](Scene& s, double x) { s.sheets[sheet].target[k] += x * shift; });
                CHECK_NEAR(by_node_target.dot(shift), targeted, kDifferences * (1.0 + scale));
                const double started =
                    numeric(kStep, [&](Scene& s, double x) { s.sheets[sheet].start[k] += x * shift; });
                CHECK_NEAR((place + start).dot(shift), started, kDifferences * (1.0 + scale));
                const double by_mass = adjoint.node_mass_gradient[i] - z_node.dot(point.y.nodes[i] - node.target);
                const double weighed =
                    numeric(1e-3 * node.mass, [&](Scene& s, double x) { s.sheets[sheet].mass[k] += x; });
                CHECK_NEAR(by_mass, weighed, 1e-4 * std::abs(by_mass) + 1e-7);
                by_stiffness += std::abs(adjoint.node_mass_gradient[i]);
            }
            const std::pair<double ClothParameters::*, double> fields[] = {
                {&ClothParameters::stretch, adjoint.cloth_gradient[sheet].stretch},
                {&ClothParameters::shear, adjoint.cloth_gradient[sheet].shear},
                {&ClothParameters::bend, adjoint.cloth_gradient[sheet].bend},
                {&ClothParameters::damping, adjoint.cloth_gradient[sheet].damping}};
            for (const auto& [field, analytic] : fields) {
                const double value = scene.materials[sheet].*field;
                const double by_difference =
                    numeric(1e-4 * value, [&, f = field](Scene& s, double x) { s.materials[sheet].*f += x; });
                CHECK(analytic != 0.0);
                CHECK_NEAR(analytic * value, by_difference * value, 1e-4 * std::abs(analytic * value) + 1e-9);
            }
        }
        CHECK(by_stiffness > 0.0);
    }
}

TEST(exact_adjoint_agrees_with_differences_of_the_solve) {
    for (const bool is_stack : {true, false}) {
        NOTE(is_stack);
        const Scene scene = is_stack ? stack() : landing();
        ZonePoint point;
        const Zone zone = scene.solve(point);
        const std::size_t count = scene.bodies.size();
        const Coordinates upstream = random_upstream(zone, 5);
        AdjointWorkspace workspace;
        const ZoneAdjoint adjoint =
            zone_adjoint(zone, point, {}, upstream, AdjointMode::exact, GradientNeeds{}, workspace);
        const auto loss = [&](const Scene& changed) { return flatten(upstream).dot(changed.solution()); };

        // d(loss)/d(target) = M z
        for (std::size_t i = 0; i < count; ++i) {
            NOTE(i);
            const ZoneBody& body = scene.bodies[i];
            const Vec6& z = adjoint.multiplier.bodies[i];
            Vec6 by_target, by_start;
            by_target << body.inertia * z.head<3>(), body.mass * z.tail<3>();
            const auto targeted = [&](const VectorX& x) {
                Scene changed = scene;
                changed.bodies[i].target += x;
                return loss(changed);
            };
            CHECK(by_target.norm() > 1e-2);
            CHECK_NEAR(by_target, fixtures::numeric_gradient(targeted, VectorX::Zero(6), kStep), kDifferences);

            // The base pose moves, targets and inertia stay: a turn arrives at the end of
            // the step turned by Exp(theta).
            const Vec6& pose = adjoint.pose_gradient.bodies[i];
            by_start << exp_rotation(point.y.bodies[i].head<3>()).transpose() * pose.head<3>(), pose.tail<3>();
            const auto started = [&](const VectorX& x) {
                Scene changed = scene;
                changed.bodies[i].start.R = exp_rotation(Vec3(x.head<3>())) * body.start.R;
                changed.bodies[i].start.t += x.tail<3>();
                return loss(changed);
            };
            const VectorX numeric = fixtures::numeric_gradient(started, VectorX::Zero(6), kStep);
            CHECK(by_start.norm() > 1e-2);
            CHECK_NEAR(by_start, numeric, 10.0 * kDifferences * (1.0 + by_start.norm()));

            // The mass, through the contacts' stiffness and through the inertial term.
            const double by_mass =
                adjoint.mass_gradient[i] - z.tail<3>().dot((point.y.bodies[i] - body.target).tail<3>());
            const auto weighed = [&](const VectorX& x) {
                Scene changed = scene;
                changed.bodies[i].mass += x[0];
                return loss(changed);
            };
            const double heavier = fixtures::numeric_gradient(weighed, VectorX::Zero(1), 1e-3 * body.mass)[0];
            CHECK(std::abs(by_mass) > 1e-7);
            CHECK_NEAR(by_mass, heavier, 1e-4 * std::abs(by_mass) + 1e-9);
        }
    }
}

TEST(what_is_not_asked_for_is_left_at_zero) {
    for (double compliance : {1e-2, 0.0}) {
        Scene scene = caught();
        scene.compliance = compliance;
        ZonePoint point;
        const Zone zone = scene.solve(point);
        const Coordinates upstream = random_upstream(zone, 6);
        AdjointWorkspace workspace;
        const GradientNeeds nothing{false, false, false, false};
        const ZoneAdjoint all = zone_adjoint(zone, point, {}, upstream, AdjointMode::exact, GradientNeeds{}, workspace);
        const ZoneAdjoint none = zone_adjoint(zone, point, {}, upstream, AdjointMode::exact, nothing, workspace);
        CHECK(flatten(none.multiplier) == flatten(all.multiplier));
        for (std::size_t i = 0; i < all.pose_gradient.nodes.size(); ++i) CHECK(none.pose_gradient.nodes[i].isZero(0.0));
        for (std::size_t i = 0; i < all.mass_gradient.size(); ++i) CHECK(none.mass_gradient[i] == 0.0);
        CHECK(all.cloth_gradient[0].stretch != 0.0);
        CHECK(none.cloth_gradient[0].stretch == 0.0);
    }
}

TEST(exact_adjoint_carries_the_motion_of_bodies_that_do_not_yield) {
    const Scene scene = landing();
    ZonePoint point;
    const Zone zone = scene.solve(point);
    CHECK(zone.body_count() == 2);
    const Coordinates upstream = random_upstream(zone, 6);
    AdjointWorkspace workspace;
    const ZoneAdjoint adjoint = zone_adjoint(zone, point, {}, upstream, AdjointMode::exact, GradientNeeds{}, workspace);
    const auto moved = [&](const VectorX& x) {
        Scene changed = scene;
        Pose& start = changed.passive.bodies[0].start;
        start = {exp_rotation(Vec3(x.head<3>())) * start.R, start.t + x.tail<3>()};
        changed.plant_tree();
        return flatten(upstream).dot(changed.solution());
    };
    const Vec6& analytic = adjoint.pose_gradient.bodies[1];
    CHECK(analytic.tail<3>().norm() > 1e-2);
    CHECK_NEAR(
        analytic, fixtures::numeric_gradient(moved, VectorX::Zero(6), kStep), 10.0 * kDifferences * analytic.norm());
}

TEST(modes_differ_where_contacts_turn) {
    ZonePoint point;
    const Scene scene = landing();
    const Zone zone = scene.solve(point);
    const Coordinates upstream = random_upstream(zone, 7);
    const VectorX exact = multiplier(zone, point, upstream, AdjointMode::exact);
    const VectorX linear = multiplier(zone, point, upstream, AdjointMode::dense);
    CHECK((exact - linear).norm() > 1e-4 * exact.norm());
}

}  // namespace test_adjoint
