#pragma once

#include "zone/zone_derivatives.hpp"

/// How near a zone is to its minimum, and what rounding lets one know of it.
namespace diffsim {

/// How far a point is from the minimum.
struct Accuracy {
    double residual;   ///< largest |L⁻¹ g| of a body or node, M = L Lᵀ, relative to the largest force
    double floor;      ///< what rounding leaves of it
    double reference;  ///< that largest force
};

/// Largest |L⁻¹ g| of a body or node.
double largest_scaled(const Zone& zone, const Coordinates& g);
/// Largest |Lᵀ p|.
double largest_motion(const Zone& zone, const Coordinates& p);

/// From derivatives with a Hessian, or with the contacts' stiffness at least. `position`: size of the numbers that
/// distances are differences of [m].
Accuracy accuracy(const Zone& zone, const ZoneDerivatives& derivatives, double position);

/// What rounding can do to the energy. `system` holds the zone's last Hessian, `pushed` is scratch.
double energy_noise(
    const Zone& zone, const ZonePoint& point, const BlockSystem& system, double position, std::vector<double>& pushed);

}  // namespace diffsim
