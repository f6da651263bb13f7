#pragma once

#include "zone/zone_derivatives.hpp"

/// From the twists of bodies, along which contacts act, to their coordinates (theta, u).
namespace diffsim {

/// d(twist)/dy of a body at theta: turns by the left Jacobian, shifts unchanged.
Mat6 chart_jacobian(const Vec6& y);

/// Second derivative of the chart itself: what turning contributes to the Hessian for a contact torque.
Mat3 chart_curvature(const Vec6& y, const Vec3& torque);

/// Turn derivatives along twists, the contacts' alone, into such along coordinates, and keep torques and Jacobians.
/// Curvature::dropped leaves the chart's own out.
void to_coordinates(
    const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut, ZoneDerivatives& derivatives,
    BlockSystem* system);

}  // namespace diffsim
