#pragma once

#include "zone/zone.hpp"

namespace diffsim {

/// Add the contacts' part of the energy's derivatives, along the bodies' twists and the nodes: gradient, largest force
/// and stiffness, and, unless `system` is null, the Hessian, with so much of the negative curvature cut off: of all
/// contacts of two bodies or of one with the ground together, of cloth contact by contact. `system` must have the pattern
/// of these contacts.
void add_contact_derivatives(
    const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
    BlockSystem* system);

/// The same of contacts that push with these forces, whatever their distances: -force d²(distance), and no stiffness.
void add_contact_curvature(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut,
    ZoneDerivatives& derivatives, BlockSystem& system);

}  // namespace diffsim
