#pragma once

#include "contact/zone.hpp"

namespace diffsim {

/// Take this share of its negative part off a Hessian. For the sizes of positive_part.
template <int N>
void cut_off(CutShare cut, Eigen::Matrix<double, N, N>& hessian);

/// Add the contacts' part of the energy's derivatives, along the bodies' twists and the nodes: gradient, largest force
/// and stiffness, and, unless `system` is null, the Hessian, each pair of objects' with so much of its negative
/// curvature cut off. `system` must have the pattern of these contacts.
void add_contact_derivatives(
    const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
    BlockSystem* system);

}  // namespace diffsim
