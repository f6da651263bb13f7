#pragma once

#include "contact/zone_contacts.hpp"

namespace diffsim {

/// A linearised contact: gap + rowᵀ p should reach a distance. Half-spaces with a penalty, see solve_impact_qp.
struct ImpactRow {
    int a = -1, b = -1;  ///< bodies of the zone; -1 where one does not yield or is none
    int pair = -1;       ///< block of the Hessian, or -1
    Vec6 row_a = Vec6::Zero(), row_b = Vec6::Zero();
    int node_count = 0;  ///< free nodes that take part
    std::array<int, 6> nodes = {};
    std::array<Vec3, 6> node_rows;
    double missing = 0.0;    ///< what p has to make up for: violated by max(0, missing - rowᵀ p) [m]
    double stiffness = 0.0;  ///< [kg]
};

/// Everything at some coordinates.
struct Placement {
    Coordinates y;
    std::vector<Pose> poses;
    std::vector<Vec3> nodes;
};

/// The row that asks for a distance, linearised where the objects are placed, for p counted from y_now. What moves as
/// told does its part.
ImpactRow make_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now, double wanted);

/// min over p of ½ pᵀ A p + gᵀ p + Σ stiffness/2 max(0, missing - rowᵀ p)², by Newton's method on this piecewise
/// quadratic with exact line search. A is diagonal for bodies, their masses scaled by `mass_factor`, and `cloth` for nodes.
/// `p` holds the start, which pinned nodes keep, and receives the minimiser. Scratch: `system`, whose pattern has the
/// rows' pairs. Returns the number of Newton steps.
int solve_impact_qp(
    const Zone& zone, const Coordinates& gradient, const std::vector<double>& mass_factor, const BlockSystem* cloth,
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
