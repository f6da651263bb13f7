#include "solve/model_direction.hpp"

#include <algorithm>
#include <cmath>
#include <optional>

#include "cloth_fixtures.hpp"
#include "math/rotation.hpp"

namespace test_model_direction {

using namespace diffsim;

namespace {

constexpr double kHalf = 0.05;       // edge of the boxes, half [m]
constexpr double kThickness = 1e-4;  // [m]
constexpr double kApart = 10.0;      // from pair to pair of boxes [m]
constexpr double kAgreement = 1e-9;  // of ways, relative to their lengths

/// Pairs of boxes far from each other, and a direction from where they are.
struct Scene {
    Model model;
    std::vector<ClothParameters> materials;
    PassiveBodies passive;
    Zone zone;
    ZonePoint point, trial;
    ContactCoverage coverage;
    BlockSystem system;
    std::optional<ZonePath> path;
    std::optional<ModelDirection> direction;
    Coordinates targets;

    Scene() {
        model.thickness = kThickness;
        make_zone(zone, model, materials, kDefaultCompliance, Vec3::Zero());
    }
    void add_box(const Pose& pose, const Vec6& target) {
        const Vec3 half = Vec3::Constant(kHalf);
        const int id = model.body_count();
        model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness));
        zone.bodies.push_back(fixtures::zone_body(id, pose, 1.0, fixtures::box_inertia(half, 1.0)));
        zone.bodies.back().target = target;
        ++zone.dynamic_count;
    }
    /// Two tilted boxes, a corner of one near a face of the other, about to turn and move into each other. `size` of
    /// the motion: 1 is far for the boxes.
    void add_pair(check::Random& random, double size) {
        const Mat3 tilt = exp_rotation(3.0 * fixtures::random_direction(random));
        const double reach = (tilt * Vec3::Constant(kHalf).cwiseProduct(tilt.row(2).transpose().cwiseSign())).z();
        const double gap = kThickness * random.uniform(0.7, 5.0), x = 0.5 * kApart * zone.dynamic_count;
        for (int i = 0; i < 2; ++i) {
            Vec6 target;
            target << 0.3 * size * fixtures::random_vec3(random), 0.01 * size * fixtures::random_vec3(random);
            target[5] = (i == 0 ? 1.0 : -1.0) * std::abs(target[5]);
            add_box({i == 0 ? Mat3(Mat3::Identity()) : tilt, Vec3(x + 0.01, 0.02, i * (kHalf + reach + gap))}, target);
        }
    }
    /// An edge on an edge, `gap` apart, crossing it at this angle.
    void add_crossing(check::Random& random, double angle, double gap, const Vec6& target_below) {
        const Mat3 on_edge = exp_rotation(Vec3(0.25 * fixtures::kPi, 0.0, 0.0));
        const Vec3 above(random.uniform(-0.01, 0.01), 0.0, 2.0 * std::sqrt(2.0) * kHalf + gap);
        add_box({on_edge, Vec3::Zero()}, target_below);
        add_box({exp_rotation(Vec3(0.0, 0.0, angle)) * on_edge, above}, Vec6::Zero());
    }
    /// At the start of the step.
    void start() {
        targets.assign_zero(zone.bodies.size(), 0);
        point.y = targets;
        path.emplace(zone, passive, point, trial, coverage, system);
        path->set_to_targets(targets);
        path->list_contacts(targets);
        evaluate(zone, point);
        direction.emplace(zone, *path, point, system);
    }
    Coordinates gradient() const {
        ZoneDerivatives derivatives;
        differentiate(zone, point, Curvature::none, derivatives, nullptr);
        return derivatives.gradient;
    }
    ModelDirection::Way find(Coordinates& y_end) {
        y_end = point.y;
        const ModelDirection::Way way = direction->find(gradient(), true, y_end);
        CHECK(way.found);
        return way;
    }
    Coordinates end() {
        Coordinates y_end;
        find(y_end);
        return y_end;
    }
};

/// The model with a row for every listed contact, one by one.
struct Reference {
    ContactModel model;
    bool solved;
    Coordinates y_end;

    /// `forces`: of the last model, per contact of the zone.
    explicit Reference(const Scene& scene, const std::vector<double>& forces = {}) {
        const Zone& zone = scene.zone;
        const ZonePoint& point = scene.point;
        std::vector<ContactGeometry> geometries;
        for (const ZoneContact& contact : zone.contacts)
            geometries.push_back(contact_geometry(zone, contact, point.poses, point.nodes));
        std::vector<PushingContact> pushing;
        for (std::size_t k = 0; k < forces.size(); ++k)
            if (forces[k] > 0.0) pushing.push_back({static_cast<int>(k), &geometries[k], forces[k]});
        ZoneDerivatives derivatives;
        model.smooth.set_pattern(base_pattern(zone));
        differentiate_smooth(zone, point, pushing, kNothingCut, derivatives, model.smooth);
        model.gradient = scene.gradient();
        const Placement at{point.y, point.poses, point.nodes};
        for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
            const ZoneContact& contact = zone.contacts[k];
            const double rest = contact.law.range.rest, compression = rest - geometries[k].distance;
            if (geometries[k].sine_sq == 0.0) continue;
            ContactRow row = make_row(zone, contact, geometries[k], at, point.y, rest);
            row.contact = static_cast<int>(k);
            row.range = rest - contact.law.range.floor;
            const double pushes = normal_force(contact.law, geometries[k].distance).force;
            row.stiffness = edge_mollifier(geometries[k].sine_sq).value *
                            (compression > 0.0 ? pushes / compression : contact.law.stiffness.value);
            if (compression > 0.0) add_row(row, row.stiffness * compression, model.gradient);
            model.rows.push_back(row);
        }
        BlockSystem system;
        system.set_pattern(model.smooth.pattern());
        ModelWorkspace workspace;
        Coordinates p;
        p.assign_zero(static_cast<std::size_t>(zone.dynamic_count), 0);
        solved = minimise(model, 1.0, 0.0, system, workspace, p).status == ModelSolution::Status::solved;
        y_end = point.y;
        for (std::size_t i = 0; i < y_end.bodies.size(); ++i) {
            if (zone.yields(static_cast<int>(i)))
                y_end.bodies[i] += p.bodies[i];
            else
                y_end.bodies[i] = zone.bodies[i].target;
        }
    }
    std::vector<double> forces(const Zone& zone) const {
        std::vector<double> result(zone.contacts.size(), 0.0);
        for (const ContactRow& row : model.rows) result[static_cast<std::size_t>(row.contact)] = row.force;
        return result;
    }
    int pushing() const {
        return static_cast<int>(
            std::count_if(model.rows.begin(), model.rows.end(), [](const ContactRow& r) { return r.force > 0.0; }));
    }
};

void check_same(const Coordinates& found, const Coordinates& expected, double tolerance) {
    const VectorX x = fixtures::flatten(expected);
    CHECK_NEAR(fixtures::flatten(found), x, tolerance * x.norm());
}

/// Whether a pair that is hit on the way has turned over at its end.
bool turns_over(const Scene& scene, const Coordinates& y_end, const std::vector<Impact>& impacts) {
    std::vector<Pose> poses;
    std::vector<Vec3> nodes;
    place(scene.zone, y_end, poses, nodes);
    return std::any_of(impacts.begin(), impacts.end(), [&](const Impact& impact) {
        const ZoneContact& contact = scene.zone.contacts[impact.contact];
        const Vec3 now = contact_geometry(scene.zone, contact, scene.point.poses, scene.point.nodes).normal;
        return now.dot(contact_geometry(scene.zone, contact, poses, nodes).normal) < 0.0;
    });
}

/// Of the first pair's motion, by its masses.
double length(const Zone& zone, const Coordinates& y) {
    double sum = 0.0;
    for (std::size_t i = 0; i < 2; ++i) sum += y.bodies[i].dot(mass_times(zone.bodies[i], y.bodies[i]));
    return std::sqrt(sum);
}

}  // namespace

TEST(ways_are_those_of_a_model_with_a_row_for_every_contact) {
    check::Random random(1);
    int cases_hit = 0, curved = 0, mollified = 0;
    for (int k = 0; k < 60; ++k) {
        NOTE(k);
        Scene scene;
        if (k % 4 == 3)  // nearly parallel edges
            scene.add_crossing(
                random, random.uniform(0.004, 0.02), kThickness * random.uniform(0.7, 1.5), 1e-3 * Vec6::Unit(5));
        else
            for (int pair = 0; pair < 1 + k % 3; ++pair) scene.add_pair(random, k % 2 == 0 ? 0.05 : 0.3);
        scene.start();
        scene.end();  // which may list more contacts
        scene.direction.emplace(scene.zone, *scene.path, scene.point, scene.system);
        const int list = scene.path->list_number();
        std::vector<double> forces;
        Coordinates last = scene.point.y;
        for (int model = 0; model < 3; ++model) {
            // The next one from the same place knows the forces, and has their curvature.
            NOTE(model);
            const Reference reference(scene, forces);
            if (!reference.solved || reference.pushing() == 0) break;
            if (allowed_step(scene.zone, scene.point, reference.y_end, nullptr) < 1.0) break;
            if (!scene.path->covers(reference.y_end)) break;
            Coordinates y_end;
            CHECK(scene.find(y_end).free == 1.0);
            CHECK(scene.path->list_number() == list);
            check_same(y_end, reference.y_end, kAgreement);
            const double change = (fixtures::flatten(y_end) - fixtures::flatten(last)).norm();
            curved += model == 1 && change > 1e-6 ? 1 : 0;
            mollified += k % 4 == 3 ? 1 : 0;
            ++cases_hit;
            forces = reference.forces(scene.zone);
            last = y_end;
        }
    }
    CHECK(cases_hit >= 60);
    CHECK(curved >= 10);
    CHECK(mollified >= 10);
}

TEST(where_the_gradient_of_the_energy_vanishes_the_model_leads_nowhere) {
    check::Random random(2);
    int compressed = 0, mollified = 0;
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        // Targets such that the contact holds the bodies.
        Scene scene;
        scene.add_crossing(
            random, k % 2 == 0 ? random.uniform(0.004, 0.02) : random.uniform(0.1, 1.0),
            kThickness * random.uniform(0.7, 0.95), Vec6::Zero());
        scene.start();
        const Coordinates pushes = scene.gradient();  // of the contacts alone
        for (int i = 0; i < 2; ++i)
            scene.zone.bodies[i].target = scene.targets.bodies[i] =
                inverse_mass_times(scene.zone.bodies[i], pushes.bodies[i]);
        evaluate(scene.zone, scene.point);
        for (int model = 0; model < 2; ++model)  // the second with curvature
            CHECK(fixtures::flatten(scene.end()).norm() <= 1e-9 * fixtures::flatten(scene.targets).norm());
        for (const ActiveContact& active : scene.point.active) {
            ++compressed;
            mollified += active.geometry.sine_sq > 0.0 && active.geometry.sine_sq < kParallelLimit ? 1 : 0;
        }
    }
    CHECK(compressed >= 40);
    CHECK(mollified >= 15);
}

TEST(ways_that_are_stopped_are_led_past_what_stops_them) {
    check::Random random(3);
    int stopped = 0, freed = 0, turned = 0, near = 0;
    for (int k = 0; k < 300; ++k) {
        NOTE(k);
        Scene scene;
        scene.add_pair(random, 1.0);
        scene.start();
        Coordinates y_end;
        const ModelDirection::Way way = scene.find(y_end);
        const Reference reference(scene);
        CHECK(way.free == allowed_step(scene.zone, scene.point, y_end, nullptr));
        std::vector<Impact> impacts;
        if (allowed_step(scene.zone, scene.point, reference.y_end, &impacts) == 1.0) continue;
        ++stopped;
        freed += way.free == 1.0 ? 1 : 0;
        if (!turns_over(scene, reference.y_end, impacts)) continue;
        ++turned;
        // A row that does not know which side it is on leads away from there, or back through the other body.
        Coordinates change = y_end;
        for (std::size_t i = 0; i < 2; ++i) change.bodies[i] -= reference.y_end.bodies[i];
        near += length(scene.zone, change) < 0.3 * length(scene.zone, reference.y_end) ? 1 : 0;
    }
    CHECK(stopped >= 40);
    CHECK(freed == stopped);
    CHECK(turned >= 40);
    CHECK(near >= turned / 2);
}

TEST(damping_slows_the_bodies_whose_contacts_ask_for_it_alone) {
    check::Random random(4);
    int cases_hit = 0;
    for (int k = 0; k < 60; ++k) {
        NOTE(k);
        Scene scene;
        scene.add_pair(random, 0.05);
        scene.add_pair(random, 0.05);
        scene.add_box({Mat3::Identity(), Vec3(0.0, kApart, 0.0)}, 0.01 * random.vector(6));  // meets nothing
        scene.start();
        Coordinates begin = scene.point.y, undamped;
        scene.end();
        if (scene.find(undamped).free < 1.0) continue;
        // Where the first pair is pressed further than any model said.
        ZonePoint pressed;
        pressed.y = begin;
        double gap = kInfinity;
        for (std::size_t c = 0; c < scene.zone.contacts.size(); ++c)
            if (scene.zone.contacts[c].a == 0) gap = std::min(gap, scene.point.distances[c]);
        pressed.y.bodies[1][5] = -(gap - 0.6 * kThickness);
        evaluate(scene.zone, pressed);
        if (pressed.active.empty() || pressed.energy == kInfinity) continue;
        if (scene.zone.contacts[pressed.active.back().index].a >= 2) continue;  // the second pair asks as well
        const auto next = [&](int damped, int relaxed) {
            scene.direction.emplace(scene.zone, *scene.path, scene.point, scene.system);
            scene.end();
            for (int i = 0; i < damped; ++i) scene.direction->damp(pressed, 0.0);
            for (int i = 0; i < relaxed; ++i) scene.direction->relax();
            return scene.end();
        };
        next(0, 0);  // which may list more contacts
        const int list = scene.path->list_number();
        const Coordinates plain = next(0, 0), damped = next(1, 0), more = next(2, 0);
        const Coordinates undone = next(1, 1), half_undone = next(2, 1);
        if (scene.path->list_number() != list) continue;
        CHECK_NEAR(damped.bodies[4], scene.zone.bodies[4].target, 1e-15);
        // Rows may be made again where the way of the first pair ends: they are others for all.
        for (int i = 2; i < 4; ++i) CHECK_NEAR(more.bodies[i], plain.bodies[i], 1e-3 * plain.bodies[i].norm());
        CHECK(length(scene.zone, damped) < 0.95 * length(scene.zone, plain));
        CHECK(length(scene.zone, more) < 0.95 * length(scene.zone, damped));
        check_same(undone, plain, 1e-14);
        check_same(half_undone, damped, 1e-14);
        ++cases_hit;
    }
    CHECK(cases_hit >= 8);
}

}  // namespace test_model_direction
