#pragma once

#include "zone/zone_derivatives.hpp"

/// The contacts' term of a zone's energy.
namespace diffsim {

/// Extend the system's pattern by what contacts of cloth couple, if need be.
void ensure_pattern(const Zone& zone, const std::vector<int>& contacts, BlockSystem& system);

/// Find the distances of a point whose bodies and nodes are placed, which contacts are active,
/// and the term; see evaluate().
void evaluate_contacts(const Zone& zone, ZonePoint& point, const ZonePoint* before);

/// Add the contacts' part of the energy's derivatives, along the bodies' twists and the nodes: gradient, largest force
/// and stiffness, and, unless `system` is null, the Hessian, with so much of the negative curvature cut off: of all
/// contacts of two bodies or of one with the ground together, of cloth contact by contact. `system` must have
/// the pattern of these contacts.
void add_contact_derivatives(
    const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
    BlockSystem* system);

/// The same of contacts that push with these forces, whatever their distances: -force d²(distance), and no stiffness.
void add_contact_curvature(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut,
    ZoneDerivatives& derivatives, BlockSystem& system);

/// Bound on the sum of the contacts' forces: what rounding of distances does to the energy is in
/// proportion. `pushed` is scratch.
double contact_force_sum(const Zone& zone, const ZonePoint& point, std::vector<double>& pushed);

}  // namespace diffsim
