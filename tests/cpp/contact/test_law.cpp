#include "contact/law.hpp"

#include <cmath>

#include "fixtures.hpp"

namespace test_law {

using namespace diffsim;

namespace {

constexpr double kDifferences = 1e-9;  // relative; fourth-order differences of functions solved to eps

template <typename Function>
double derivative(const Function& function, double x, double step) {
    return fixtures::numeric_gradient(
        [&](const VectorX& at) { return function(at[0]); }, VectorX::Constant(1, x), step)[0];
}

}  // namespace

TEST(stiffness_gradients_agree_with_differences) {
    constexpr double kCompliance = 1e-4;
    for (const double mass_a : {1.0, 1e-3, 40.0}) {
        for (const double ratio : {1.0, 3.0, 1.0 / 3.0, 99.0, 101.0, 1e-4, 1e6}) {
            NOTE(mass_a);
            NOTE(ratio);
            const double mass_b = ratio * mass_a;
            const ContactStiffness k = contact_stiffness(mass_a, mass_b, kCompliance);
            const auto log_a = [&](double m) { return std::log(contact_stiffness(m, mass_b, kCompliance).value); };
            const auto log_b = [&](double m) { return std::log(contact_stiffness(mass_a, m, kCompliance).value); };
            const double scale_a = kDifferences * (1.0 / mass_a), scale_b = kDifferences * (1.0 / mass_b);
            CHECK(k.value > 0.0);
            CHECK(std::abs(k.log_gradient_a) * mass_a + std::abs(k.log_gradient_b) * mass_b > 0.5);
            CHECK_NEAR(derivative(log_a, mass_a, 1e-3 * mass_a), k.log_gradient_a, scale_a);
            CHECK_NEAR(derivative(log_b, mass_b, 1e-3 * mass_b), k.log_gradient_b, scale_b);
            const ContactStiffness swapped = contact_stiffness(mass_b, mass_a, kCompliance);
            CHECK_NEAR(swapped.value, k.value, 1e-14 * k.value);
            CHECK_NEAR(swapped.log_gradient_b, k.log_gradient_a, 1e-14 / mass_a);
        }
        for (const bool a_yields : {true, false}) {
            const ContactStiffness k = a_yields ? contact_stiffness(mass_a, kInfinity, kCompliance)
                                                : contact_stiffness(kInfinity, mass_a, kCompliance);
            CHECK_NEAR(k.value, mass_a / kCompliance, 1e-12 * k.value);
            CHECK_NEAR(a_yields ? k.log_gradient_a : k.log_gradient_b, 1.0 / mass_a, 1e-14 / mass_a);
            CHECK((a_yields ? k.log_gradient_b : k.log_gradient_a) == 0.0);
        }
    }
}

TEST(stiffness_is_continuous_where_the_mass_ratio_begins_to_count) {
    const double below = contact_stiffness(1.0, 100.0 * (1.0 - 1e-12), 1e-4).value;
    const double above = contact_stiffness(1.0, 100.0 * (1.0 + 1e-12), 1e-4).value;
    CHECK_NEAR(below, above, 1e-11 * above);
    CHECK(contact_stiffness(1.0, 1e4, 1e-4).value > 50.0 * below);
}

TEST(distances_of_a_contact_are_in_order) {
    for (const double margin_sum : {1e-4, 1e-3, 0.2}) {
        const ContactRange range = contact_range(margin_sum, 1e-3);
        CHECK(range.rest == margin_sum);
        CHECK(range.rest > range.landing);
        CHECK(range.landing > range.floor);
        CHECK(range.floor > range.pole);
        CHECK(range.pole > range.limit);
        CHECK(range.limit >= 0.0);
        CHECK_NEAR(range.rest - range.limit, std::min(margin_sum, 1e-3), 1e-15);
    }
}

TEST(a_contact_next_to_its_pole_is_given_room) {
    const ContactRange range = contact_range(1e-3, 1e-3);
    const ContactRange same = rescued_range(range, range.floor);
    CHECK(same.pole == range.pole);
    CHECK(same.floor == range.floor);
    for (const double part : {0.01, 0.3, 0.9}) {
        const double start = range.limit + part * (range.pole - range.limit);
        const ContactRange rescued = rescued_range(range, start);
        CHECK(rescued.rest == range.rest);
        CHECK(rescued.pole > range.limit);
        CHECK(rescued.pole < rescued.floor);
        CHECK(rescued.floor < start);
    }
}

TEST(the_normal_force_counts_from_the_rest_distance_to_the_pole) {
    ContactLaw law{contact_range(1e-3, 1e-3), {3e4, 0.0, 0.0}};
    CHECK(normal_force(law, law.range.rest).force == 0.0);
    CHECK(normal_force(law, law.range.pole).force == kInfinity);
    const double distance = 0.6e-3, depth = law.range.rest - law.range.pole;
    CHECK(normal_force(law, distance).force == contact_potential(law.range.rest - distance, depth, 3e4).force);
    // Shifted for a force, twice the same: it acts at the rest distance, and the pole has not moved.
    const ContactRange before = law.range;
    for (int k = 0; k < 2; ++k) {
        shift_rest(law, 7.0);
        CHECK(law.shift > 0.0);
        CHECK(law.range.pole == before.pole);
        CHECK_NEAR(law.range.rest, before.rest + law.shift, 1e-18);
        CHECK_NEAR(normal_force(law, before.rest).force, 7.0, 1e-10);
    }
}

}  // namespace test_law
