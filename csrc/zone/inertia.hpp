#pragma once

#include "zone/zone_derivatives.hpp"

/// The term ½ (y - ŷ)ᵀ M (y - ŷ) of a zone's energy.
namespace diffsim {

double inertial_energy(const Zone& zone, const Coordinates& y);

/// Add its derivatives, the last ones to be added to those of nodes: what is there by then is all that inertia has to
/// balance, and its size is noted. Pinned nodes have no gradient, and rows of the unit matrix.
void add_inertia(const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem* system);

}  // namespace diffsim
