#pragma once

#include "contact/zone_contacts.hpp"

namespace diffsim {

/// A linearised contact: gap + rowᵀ p should reach a distance. Half-spaces with a penalty, see solve_impact_qp.
struct ImpactRow {
    int a, b;  ///< bodies of the zone; -1 where one does not yield
    int pair;  ///< block of the Hessian, or -1
    Vec6 row_a, row_b;
    double missing;    ///< what p has to make up for: violated by max(0, missing - rowᵀ p) [m]
    double stiffness;  ///< [kg]
};

/// min over p of ½ pᵀ S M p + gᵀ p + Σ stiffness/2 max(0, missing - rowᵀ p)², by Newton's method on this piecewise
/// quadratic with exact line search. S scales each body's mass by `mass_factor`. `p` holds the start and receives the
/// minimiser. Scratch: `system`. Returns the number of Newton steps.
int solve_impact_qp(
    const Zone& zone, const Coordinates& inertial_gradient, const std::vector<double>& mass_factor,
    const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p);

struct ImpactDirection {
    Coordinates y_end;  ///< where it leads to
    double step;        ///< how much of the way CCD allows
    int newton_steps = 0;
};

/// A direction past the impacts that stop a plain Newton step: pairs hit on the way to the target are linearised at
/// their time of impact, the QP with these rows gives a new end point, and pairs hit on the way to that one are added
/// until none is. Rows are straight and bodies turn: where a body would turn far, its mass is scaled up, which shortens
/// its part of the direction until the rows mean something.
ImpactDirection impact_direction(const Zone& zone, const ZonePoint& point, BlockSystem& system);

}  // namespace diffsim
