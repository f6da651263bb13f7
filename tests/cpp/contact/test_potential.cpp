#include "contact/potential.hpp"

#include <cmath>

#include "fixtures.hpp"

namespace test_potential {

using namespace diffsim;

namespace {

constexpr double kDifferences = 1e-9;  // relative; fourth-order differences of functions solved to eps

template <typename Function>
double derivative(const Function& function, double x, double step) {
    return fixtures::numeric_gradient(
        [&](const VectorX& at) { return function(at[0]); }, VectorX::Constant(1, x), step)[0];
}

}  // namespace

TEST(potential_agrees_with_its_formula_and_differences) {
    constexpr double kPole = 2e-3, kStiffness = 3e4;
    for (const double part : {1e-3, 0.1, 0.5, 0.9, 0.99}) {
        NOTE(part);
        const double p = part * kPole, step = 1e-3 * kPole * std::min(part, 1.0 - part);
        const PotentialValue value = contact_potential(p, kPole, kStiffness);
        CHECK(value.force > 0.0);
        CHECK(value.stiffness >= kStiffness);
        CHECK_NEAR(value.energy, 0.5 * kStiffness * p * p / (1.0 - part), 1e-14 * value.energy);
        const auto energy = [&](double at) { return contact_potential(at, kPole, kStiffness).energy; };
        const auto force = [&](double at) { return contact_potential(at, kPole, kStiffness).force; };
        CHECK_NEAR(derivative(energy, p, step), value.force, kDifferences * value.force);
        CHECK_NEAR(derivative(force, p, step), value.stiffness, kDifferences * value.stiffness);
    }
}

TEST(potential_starts_smoothly_and_ends_in_a_pole) {
    for (const double p : {-1.0, 0.0}) {
        const PotentialValue value = contact_potential(p, 1e-3, 1e4);
        CHECK(value.energy == 0.0);
        CHECK(value.force == 0.0);
        CHECK(value.stiffness == 0.0);
    }
    const PotentialValue start = contact_potential(1e-12, 1e-3, 1e4);
    CHECK_NEAR(start.force, 1e4 * 1e-12, 1e-15);
    for (const double p : {1e-3, 2e-3}) CHECK(contact_potential(p, 1e-3, 1e4).energy == kInfinity);
    CHECK(contact_potential(0.999999e-3, 1e-3, 1e4).force > 1e9 * start.force);
}

TEST(a_shifted_contact_has_its_force_at_its_rest_distance) {
    constexpr double kPole = 2e-3, kStiffness = 3e4;
    CHECK(rest_shift(0.0, kPole, kStiffness) == 0.0);
    for (const double force : {1e-9, 1e-3, 1.0, kStiffness * kPole, 1e6, 1e15}) {
        NOTE(force);
        const double shift = rest_shift(force, kPole, kStiffness);
        CHECK_NEAR(contact_potential(shift, kPole + shift, kStiffness).force, force, 1e-11 * force);
    }
}

TEST(mollifier_agrees_with_differences_and_joins_smoothly) {
    for (const double part : {0.0, 0.1, 0.5, 0.9}) {
        NOTE(part);
        const double c = part * kParallelLimit, step = 0.02 * kParallelLimit;
        const Mollifier m = edge_mollifier(c);
        CHECK(m.first > 0.0);
        CHECK_NEAR(derivative([](double at) { return edge_mollifier(at).value; }, c, step), m.first, 1e-9 * m.first);
        CHECK_NEAR(derivative([](double at) { return edge_mollifier(at).first; }, c, step), m.second, -1e-9 * m.second);
    }
    CHECK(edge_mollifier(0.0).value == 0.0);
    const Mollifier below = edge_mollifier(kParallelLimit * (1.0 - 1e-12)), above = edge_mollifier(kParallelLimit);
    CHECK_NEAR(below.value, 1.0, 1e-12);
    CHECK_NEAR(below.first * kParallelLimit, 0.0, 1e-11);
    CHECK(above.value == 1.0);
    CHECK(above.first == 0.0);
}

}  // namespace test_potential
