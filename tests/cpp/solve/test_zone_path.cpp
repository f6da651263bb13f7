#include "solve/zone_path.hpp"

#include <cmath>
#include <optional>

#include "solve_fixtures.hpp"

namespace test_zone_path {

using namespace diffsim;
using namespace fixtures::solve;

namespace {

constexpr double kAgreement = 1e-12;  // of positions [m]

/// The way of a zone of cubes from where they start, nothing listed yet.
struct Way : Cubes {
    ZonePoint point, trial;
    ContactCoverage coverage;
    BlockSystem system;
    Coordinates targets;
    std::optional<ZonePath> path;

    explicit Way(bool on_ground) : Cubes(on_ground) {}
    ZonePath& start() {
        targets.assign_zero(zone.bodies.size(), 0);
        point.y = targets;
        path.emplace(zone, nobody, point, trial, coverage, system);
        path->set_to_targets(targets);
        return *path;
    }
    ZonePath& start_listed() {
        start().list_contacts(targets);
        evaluate(zone, point);
        return *path;
    }
    /// Parts of the way from the start to the targets and beyond.
    Coordinates at(double s) const {
        Coordinates y = targets;
        scale(s, y);
        return y;
    }
};

/// A cube that falls by so much, from so far above where it touches the ground.
struct Fall : Way {
    Fall(double gap, double fall) : Way(true) {
        add(Vec3(0.0, 0.0, kTouching + gap));
        zone.bodies[0].target[5] = -fall;
    }
};

/// Two cubes, 0.2 m of air between them, that change places.
struct Crossing : Way {
    Crossing() : Way(false) {
        for (int i = 0; i < 2; ++i) {
            add(Vec3(0.0, 0.0, 0.3 * i));
            zone.bodies.back().target[5] = i == 0 ? 0.3 : -0.3;
        }
    }
};

}  // namespace

TEST(targets_are_where_bodies_go_when_nothing_touches_them) {
    Fall fall(1.0, kFall);
    fall.zone.bodies[0].target << 0.1, 0.2, 0.3, 0.4, 0.5, 0.6;
    fall.start();
    CHECK(fall.targets.bodies[0] == fall.zone.bodies[0].target);
    CHECK(fall.zone.contacts.empty());
}

TEST(a_list_covers_its_way_and_what_is_near_it_and_is_made_anew_for_others) {
    Fall fall(0.5 * kFall, kFall);
    ZonePath& path = fall.start_listed();
    CHECK(path.list_number() == 1);
    CHECK(fall.zone.contacts.size() == 4);  // the vertices below
    for (const double s : {0.0, 0.5, 1.0}) CHECK(path.covers(fall.at(s)));
    CHECK(!path.ensure_covered(fall.targets));
    CHECK(path.list_number() == 1);

    Coordinates aside = fall.targets;
    aside.bodies[0][3] += 1.0;
    CHECK(!path.covers(aside));
    CHECK(path.ensure_covered(aside));
    CHECK(path.list_number() == 2);
    for (const double s : {0.0, 0.5, 1.0}) {
        Coordinates on_the_way = aside;
        scale(s, on_the_way);
        CHECK(path.covers(on_the_way));
    }
}

TEST(what_no_list_of_contacts_would_be_of_use_for_is_covered_all_the_same) {
    Fall far(10.0, kFall);
    ZonePath& path = far.start_listed();
    CHECK(far.zone.contacts.empty());
    CHECK(path.covered_step(far.targets) == 1.0);
    CHECK(path.list_number() == 1);
}

TEST(a_step_ends_before_the_ground_and_what_it_leaves_free_is_free) {
    const double gap = 0.3 * kFall;
    Fall fall(gap, kFall);
    ZonePath& path = fall.start_listed();
    const double step = path.arc_step(fall.targets, 1.0);
    CHECK_NEAR(step * kFall, gap, kThickness);  // between touching and the contact's pole
    CHECK(step * kFall > gap - kAgreement);
    CHECK(path.arc_step(fall.targets, step) == step);
    CHECK_NEAR(fall.trial.y.bodies[0], Vec6(step * fall.targets.bodies[0]), kAgreement);
    CHECK(allowed_step(fall.zone, fall.point, fall.trial.y, nullptr) == 1.0);
    evaluate(fall.zone, fall.trial, &fall.point);
    CHECK(fall.trial.energy < kInfinity);
    CHECK(path.arc_step(fall.targets, 0.0) == 0.0);
}

TEST(a_body_that_turns_is_stopped_on_its_arc) {
    // A cube above the ground by less than what its corners reach below its faces.
    Fall turning(0.1 * kHalf, 0.0);
    turning.zone.bodies[0].target << 0.0, 0.7, 0.0, 0.0, 0.0, 0.0;
    ZonePath& path = turning.start_listed();
    const double step = path.arc_step(turning.targets, 1.0);
    CHECK(step > 0.0);
    CHECK(step < 1.0);
    evaluate(turning.zone, turning.trial, &turning.point);
    CHECK(turning.trial.energy < kInfinity);
    // Its lowest corner comes down by h (sin + cos - 1).
    const double angle = step * 0.7;
    CHECK(kHalf * (std::sin(angle) + std::cos(angle) - 1.0) < 0.1 * kHalf + kThickness);
}

TEST(a_covered_step_takes_what_is_known_to_be_free_by_its_word) {
    Fall fall(0.3 * kFall, kFall);
    ZonePath& path = fall.start_listed();
    CHECK(path.covered_step(fall.targets) < 1.0);
    CHECK(path.covered_step(fall.targets, 1.0) == 1.0);
}

TEST(bodies_that_would_change_places_stop_at_their_gate) {
    Crossing crossing;
    ZonePath& path = crossing.start_listed();
    CHECK(path.gates_hold(crossing.targets));  // none is set yet
    CHECK(path.set_gates(crossing.targets) == 1);
    CHECK(path.is_fast(0));
    CHECK(path.is_fast(1));
    CHECK(!path.is_fast(2));
    for (const double s : {0.0, 1.0 / 3.0}) CHECK(path.gates_hold(crossing.at(s)));  // they meet at 0.2 / 0.6
    CHECK(!path.gates_hold(crossing.targets));
    CHECK(!crossing.zone.contacts.empty());
    for (const ZoneContact& contact : crossing.zone.contacts) CHECK(path.is_fast(contact));
    // Even where they pass each other without touching, which a straight way to there does not.
    Coordinates around = crossing.targets;
    around.bodies[1][3] = 1.0;
    path.ensure_covered(around);
    CHECK(!path.gates_hold(around));
    CHECK(path.arc_step(around, 1.0) < 1.0);
}

TEST(slow_bodies_have_no_gates) {
    Fall fall(0.3 * kFall, kFall);
    ZonePath& path = fall.start_listed();
    CHECK(path.set_gates(fall.targets) == 0);
    CHECK(!path.is_fast(0));
    CHECK(path.gates_hold(fall.targets));
}

TEST(a_clear_step_evaluates_its_trial_and_stops_motion_of_last_step_where_contacts_hardly_push) {
    Fall fall(0.3 * kFall, kFall);
    ZonePath& path = fall.start_listed();
    const double to_floor = path.clear_step(fall.targets);
    CHECK(fall.trial.energy < kInfinity);
    CHECK(fall.trial.active.size() == 4);
    const double to_landing = path.clear_step(fall.targets, Clearance::landing);
    CHECK(0.0 < to_landing);
    CHECK(to_landing < to_floor);
    CHECK(to_floor < 1.0);
}

}  // namespace test_zone_path
