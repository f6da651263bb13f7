#pragma once

#include "math/types.hpp"

/// The energy of one contact: soft enough to be solved to rounding, stiff enough to be invisible.
namespace diffsim {

/// Energy of a compression and its derivatives with respect to the compression.
struct PotentialValue {
    double energy;     ///< [kg·m²]; the step's energy is in units of force times length times step²
    double force;      ///< first derivative
    double stiffness;  ///< second derivative
};

/// phi(p) = k/2 p² / (1 - p/P) for 0 < p < P, nothing for p <= 0, infinite from P on: the plain quadratic at
/// ordinary loads, with a pole that no load gets through.
inline PotentialValue contact_potential(double compression, double pole, double stiffness) {
    if (!(compression > 0.0)) return {0.0, 0.0, 0.0};
    const double ratio = compression / pole;
    if (!(ratio < 1.0)) return {kInfinity, kInfinity, kInfinity};
    const double growth = 1.0 / (1.0 - ratio);
    const double linear = stiffness * compression * growth;
    return {0.5 * linear * compression, linear * growth * (1.0 - 0.5 * ratio), stiffness * growth * growth * growth};
}

/// How far the rest distance of a contact with this pole has to be shifted, its pole staying where it is, for this
/// force to act where the rest distance was.
double rest_shift(double force, double pole, double stiffness);

/// Factor on the energy of a pair of edges, a function of the squared sine c of their angle:
/// mu = 2c/e - (c/e)² below e = kParallelLimit, 1 from there on. Between parallel edges the closest points jump;
/// vertex-patch pairs act there.
struct Mollifier {
    double value, first, second;  ///< and its derivatives with respect to c
};
inline constexpr double kParallelLimit = 1e-3;
Mollifier edge_mollifier(double sine_sq);

}  // namespace diffsim
