#pragma once

#include "zone/zone_point.hpp"

/// First and second derivative of a zone's energy, along its coordinates. The terms of the energy are in files of their
/// own, each with what it adds to the pattern of the Hessian, to the energy, to the derivatives and to their rounding:
/// inertia, elasticity, contacts.
namespace diffsim {

/// How the second derivative is taken.
enum class Curvature {
    none,    ///< gradient only
    full,    ///< the Hessian, as much of its negative curvature cut off as told
    dropped  ///< contacts are rows of constant direction (the paper's linearised constraint)
};

/// All contacts of two bodies, or of one and the ground.
struct PairSums {
    int a, b;
    ContactStiffness stiffness;
    Vector<12> gradient;  ///< along both twists
};

struct ZoneDerivatives {
    Coordinates gradient;  ///< zero at pinned nodes
    std::vector<PairSums> pair_sums;
    std::vector<Vec3> torque;    ///< world-frame gradient with respect to turns, contacts only
    std::vector<Mat3> jacobian;  ///< of the bodies' turns: d(turn)/d(theta)
    double largest_force;      ///< of a contact on a body, of all but inertia on a node, in units of |L⁻¹ g|, M = L Lᵀ
    double largest_stiffness;  ///< sum over a body's contacts, in units of |L⁻¹ dg/dx|; of a node with the cloth's own
};

/// The pattern of a zone's Hessian without the contacts of cloth.
BlockPattern base_pattern(const Zone& zone);

/// Gradient and Hessian of the energy at an evaluated point. `system` must have the zone's base pattern, and is
/// extended by the pairs of the contacts that are active. Rows of pinned nodes are those of the unit matrix. With all
/// negative curvature cut off (CutShare), the contacts' part is positive semidefinite as well.
void differentiate(
    const Zone& zone, const ZonePoint& point, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system,
    CutShare cut = kNothingCut);

/// A contact with a force of its own, as a row of a ContactModel has it.
struct PushingContact {
    int index;  ///< into Zone::contacts
    const ContactGeometry* geometry;
    double force;  ///< [kg·m]
};

/// The Hessian of inertia and elasticity, and what contacts that push with these forces add to it by their curvature
/// alone, so much of the negative curvature cut off. `system` has a pattern of these contacts.
void differentiate_smooth(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut,
    ZoneDerivatives& derivatives, BlockSystem& system);

/// Add a block to a system's rows of node i and columns of node j, once per pair. Pinned nodes have none.
void add_node_block(const Zone& zone, int i, int j, const Mat3& block, BlockSystem& system);

}  // namespace diffsim
