#include "solve/newton_direction.hpp"

#include <algorithm>
#include <array>

#include "solve_fixtures.hpp"
#include "zone/zone_accuracy.hpp"

namespace test_newton_direction {

using namespace diffsim;
using namespace fixtures::solve;

namespace {

constexpr double kPush = 1e-8;  // into the ground, of the 1e-7 or so that it is compressed by at rest [m]

/// A cube that rests on the ground, pushed down from where it rests.
struct Pushed : Cubes {
    ZonePoint point;
    ZoneDerivatives derivatives;
    BlockSystem system;
    NewtonDirection newton;

    explicit Pushed(double push) : Cubes(true) {
        add(Vec3(0.0, 0.0, kTouching));
        CHECK(solve().status == StepStatus::converged);
        point.y = workspace.point.y;
        point.y.bodies[0][5] -= push;
        evaluate(zone, point);
        system.set_pattern(base_pattern(zone));
    }

    /// The largest scaled gradient after a Newton step, and before it.
    std::array<double, 2> gradients() {
        Coordinates step;
        CHECK(newton.compute(zone, point, derivatives, system, step));
        CHECK(newton.is_exact());
        const double before = largest_scaled(zone, derivatives.gradient);
        ZonePoint end;
        end.y = point.y;
        end.y.bodies[0] += step.bodies[0];
        evaluate(zone, end);
        differentiate(zone, end, Curvature::none, derivatives, nullptr);
        return {largest_scaled(zone, derivatives.gradient), before};
    }
};

}  // namespace

TEST(a_newton_step_leaves_the_square_of_the_distance_to_the_solution) {
    const auto [after, before] = Pushed(kPush).gradients();
    const auto [after_tenth, before_tenth] = Pushed(0.1 * kPush).gradients();
    CHECK(before > 0.0);
    CHECK(after < 0.1 * before);
    CHECK_NEAR(before_tenth / before, 0.1, 0.02);
    CHECK_NEAR(after_tenth / after, 0.01, 0.005);
}

TEST(a_point_is_as_accurate_as_its_distance_to_the_solution_and_rounding_let_it) {
    const auto accuracy_of = [](Pushed& pushed) {
        differentiate(pushed.zone, pushed.point, Curvature::full, pushed.derivatives, &pushed.system);
        return accuracy(pushed.zone, pushed.derivatives, kHalf);
    };
    Pushed at_rest(0.0), pushed(kPush);
    const Accuracy found = accuracy_of(at_rest), off = accuracy_of(pushed);
    CHECK(found.floor < 1e-8);
    CHECK(found.residual <= std::max(1e-10, found.floor));
    CHECK(off.residual > 1e3 * found.floor);
    CHECK_NEAR(off.residual * off.reference, largest_scaled(pushed.zone, pushed.derivatives.gradient), 1e-12);
}

TEST(the_last_factor_serves_other_gradients_until_it_is_lost) {
    Pushed pushed(kPush);
    Coordinates step, again;
    CHECK(pushed.newton.compute(pushed.zone, pushed.point, pushed.derivatives, pushed.system, step));
    CHECK(pushed.newton.has_factor());
    CHECK(step.bodies[0].norm() > 0.0);
    for (Vec6& g : pushed.derivatives.gradient.bodies) g *= 2.0;
    CHECK(pushed.newton.repeat(pushed.zone, pushed.derivatives, pushed.system, again));
    CHECK(again.bodies[0] == Vec6(2.0 * step.bodies[0]));
    pushed.newton.lose_factor();
    CHECK(!pushed.newton.has_factor());
}

}  // namespace test_newton_direction
