#include "solve/zone_solver.hpp"

#include <algorithm>

#include "cloth_fixtures.hpp"
#include "solve_fixtures.hpp"

namespace test_zone_solver {

using namespace diffsim;
using namespace fixtures::solve;

namespace {

constexpr double kGap = 3e-4;  // between the cubes: within reach of lists for the fall, out of it at rest [m]

/// Two cubes side by side, that would fall if nothing held them.
struct Pair : Cubes {
    explicit Pair(bool on_ground) : Cubes(on_ground) {
        for (int i = 0; i < 2; ++i) add(Vec3(i * (2.0 * kHalf + kGap), 0.0, kTouching));
    }
    int listed_pairs() const {
        int count = 0;
        for (const ZoneContact& contact : zone.contacts) count += contact.contact.with_ground() ? 0 : 1;
        return count;
    }
    int touching_pairs() const {
        return static_cast<int>(std::count_if(
            workspace.point.active.begin(), workspace.point.active.end(),
            [&](const ActiveContact& a) { return !zone.contacts[a.index].contact.with_ground(); }));
    }
};

}  // namespace

TEST(bodies_held_by_something_list_no_neighbours_that_only_falling_would_bring_near) {
    Pair held(true);
    CHECK(held.solve().status == StepStatus::converged);
    CHECK(held.workspace.point.active.size() == 8);  // four vertices each, on the ground
    CHECK(held.listed_pairs() == 0);

    Pair falling(true);
    for (ZoneBody& body : falling.zone.bodies)
        body.last_motion[5] = -kFall;  // as if it had moved so far in the last step
    CHECK(falling.solve().status == StepStatus::converged);
    CHECK_NEAR(falling.workspace.point.y.bodies[0], held.workspace.point.y.bodies[0], 1e-12);
}

TEST(a_body_that_seems_held_meets_its_neighbour_all_the_same) {
    // Pushed aside on the ground: three times the gap, which is short of a tenth of its radius.
    Pair pushed(true);
    pushed.zone.bodies[0].target[3] = 3.0 * kGap;
    CHECK(pushed.solve().status == StepStatus::converged);
    CHECK(pushed.touching_pairs() > 0);
    const Coordinates& y = pushed.workspace.point.y;
    CHECK(y.bodies[0][3] > kGap);
    CHECK(y.bodies[1][3] > 0.5 * kGap);  // the neighbour is taken along
    for (const double distance : pushed.workspace.point.distances) CHECK(distance > 0.9 * 0.5 * kThickness);
    // Without anything that holds it, too: it was at rest in the air.
    Pair released(false);
    released.zone.bodies[0].target[3] = 3.0 * kGap;
    CHECK(released.solve().status == StepStatus::converged);
    CHECK(released.touching_pairs() > 0);
}

TEST(a_press_finds_in_few_steps_that_it_squeezes_a_pile) {
    Pair pile(true);
    const double pitch = 2.0 * kHalf + kThickness;
    pile.zone.bodies[1].start.t = pile.zone.bodies[0].start.t + Vec3(0.0, 0.0, pitch);
    pile.model.bodies.push_back(
        fixtures::body(fixtures::box(Vec3(0.1, 0.1, kHalf)), 0.5 * kThickness, BodyKind::kinematic));
    const Pose above{Mat3::Identity(), Vec3(0.0, 0.0, kHalf + 2.0 * pitch + 2.0 * kThickness)};
    const auto press = [&](double way) {
        Vec6 target = Vec6::Zero();
        target[5] = -way;
        pile.zone.bodies.resize(2);
        return solve_zone(
            pile.zone, fixtures::passive_bodies(pile.model, {{2, above, target}}), {}, pile.workspace, pile.swept);
    };
    CHECK(press(1e-4).status == StepStatus::converged);  // it comes to lie on the pile
    for (const double way : {1e-3, 5e-3, 2e-2}) {
        const ZoneResult result = press(way);
        CHECK(result.status == StepStatus::blocked);
        CHECK(result.iterations <= 2);
        CHECK(pile.workspace.point.y.bodies[2][5] < -1e-4);  // it goes as far as there is room
    }
}

}  // namespace test_zone_solver
