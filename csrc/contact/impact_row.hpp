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

/// rowᵀ p
double row_times(const ImpactRow& row, const Coordinates& p);

/// sum += force * row
void add_row(const ImpactRow& row, double force, Coordinates& sum);

}  // namespace diffsim
