#include "contact/law.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

constexpr double kMassRatioKnee = 100.0;

}  // namespace

ContactRange contact_range(double margin_sum, double thickness) {
    const double depth = std::min(margin_sum, thickness);
    return {
        margin_sum, margin_sum - 0.1 * depth, margin_sum - 0.9 * depth, margin_sum - 0.95 * depth, margin_sum - depth};
}

ContactRange rescued_range(const ContactRange& range, double start_distance) {
    if (start_distance >= range.pole + 0.1 * (range.floor - range.pole)) return range;
    ContactRange rescued = range;
    rescued.pole = range.limit + 0.5 * (start_distance - range.limit);
    rescued.floor = range.limit + 0.75 * (start_distance - range.limit);
    return rescued;
}

ContactStiffness contact_stiffness(double mass_a, double mass_b, double compliance) {
    if (std::isinf(mass_b)) return {mass_a / compliance, 1.0 / mass_a, 0.0};
    if (std::isinf(mass_a)) return {mass_b / compliance, 0.0, 1.0 / mass_b};
    const double sum = mass_a + mass_b;
    ContactStiffness result{mass_a * mass_b / sum / compliance, 1.0 / mass_a - 1.0 / sum, 1.0 / mass_b - 1.0 / sum};
    const double ratio = std::max(mass_a, mass_b) / std::min(mass_a, mass_b);
    if (ratio > kMassRatioKnee) {
        result.value *= ratio / kMassRatioKnee;
        const double sign = mass_a > mass_b ? 1.0 : -1.0;
        result.log_gradient_a += sign / mass_a;
        result.log_gradient_b -= sign / mass_b;
    }
    return result;
}

void shift_rest(ContactLaw& law, double force) {
    law.range.rest -= law.shift;
    law.shift = rest_shift(force, law.range.rest - law.range.pole, law.stiffness.value);
    law.range.rest += law.shift;
}

}  // namespace diffsim
