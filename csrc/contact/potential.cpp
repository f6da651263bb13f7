#include "contact/potential.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {

double rest_shift(double force, double pole, double stiffness) {
    // phi' at p = s, P = pole + s, is k s (1 + s / pole) (1 + s / (2 pole)): at least its linear and its cubic term,
    // and convex, so that Newton's method comes down to the solution from the right.
    double shift = std::min(force / stiffness, std::cbrt(2.0 * force / stiffness * pole * pole));
    for (;;) {
        const double ratio = shift / pole;
        const double excess = stiffness * shift * (1.0 + ratio) * (1.0 + 0.5 * ratio) - force;
        const double next = shift - excess / (stiffness * (1.0 + 3.0 * ratio + 1.5 * ratio * ratio));
        if (!(next < shift)) return shift;
        shift = next;
    }
}

Mollifier edge_mollifier(double sine_sq) {
    if (sine_sq >= kParallelLimit) return {1.0, 0.0, 0.0};
    const double ratio = sine_sq / kParallelLimit;
    return {ratio * (2.0 - ratio), 2.0 * (1.0 - ratio) / kParallelLimit, -2.0 / (kParallelLimit * kParallelLimit)};
}

}  // namespace diffsim
