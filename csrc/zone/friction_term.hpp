#pragma once

#include "contact/friction.hpp"
#include "zone/contact_term.hpp"

/// How the friction of one contact changes with where its sides are and how they have moved.
namespace diffsim {

using SlipChanges = Eigen::Matrix<double, 2, Eigen::Dynamic, 0, 2, 18>;
using TangentRows = Eigen::Matrix<double, Eigen::Dynamic, 2, 0, 18, 2>;

/// Friction of one contact at the solution. Its forces on the coordinates of both sides, Jᵀ λ with λ the force that
/// holds a back, change with where the sides are and with how they have moved during the step:
///  * slipping, λ = μ force s/|s| follows the slip s and the contact's own force;
///  * sticking, λ is whatever keeps the slip where it is: a multiplier of s = 0.
struct FrictionTerm {
    std::array<ContactTerm::Side, 2> sides;
    int side_count = 2;
    bool sticks = false;
    // Derivatives along the sides' places (twists, nodes) and their motions (y): columns; rows as the coordinates y.
    SmallMatrix force_of_place, force_of_motion;
    // Along y, with which places move: both together.
    SmallMatrix changes;
    // Sticking: the two tangential directions as forces, and the slip along them.
    TangentRows rows;
    SlipChanges slip_of_place, slip_of_motion, slip;
    Eigen::Matrix2d symmetric;  ///< slipping: the part along the rows that the symmetric matrix of a solver can hold
    double stiffness = 0.0;     ///< of the contact itself [kg]
    SmallVector force;          ///< slipping: on the coordinates y; in proportion to μ and to the contact's stiffness

    /// Call body_part(body, offset) and node_part(node, offset) for everything the term is taken along.
    template <class BodyPart, class NodePart>
    void for_each(const BodyPart& body_part, const NodePart& node_part) const {
        visit_sides(sides, side_count, body_part, node_part);
    }
};

/// Products with what has a row per coordinate of a term, of a size the compiler knows where bodies alone take part.
inline Eigen::Vector2d slips_along(const TangentRows& rows, const SmallVector& x) {
    if (x.size() == 6) return rows.topRows<6>().transpose().lazyProduct(x.head<6>());
    if (x.size() == 12) return rows.topRows<12>().transpose().lazyProduct(x.head<12>());
    return rows.transpose().lazyProduct(x);
}
inline SmallVector forces_of(const SlipChanges& slip, const Eigen::Vector2d& multiplier) {
    if (slip.cols() == 6) return slip.leftCols<6>().transpose().lazyProduct(multiplier);
    if (slip.cols() == 12) return slip.leftCols<12>().transpose().lazyProduct(multiplier);
    return slip.transpose().lazyProduct(multiplier);
}

/// Overwrite a term. `contact`: index into Zone::contacts; `force`: what it pushes with.
void make_friction_term(
    const Zone& zone, const ZonePoint& point, int contact, const ContactGeometry& geometry, double force,
    const ContactFriction& friction, FrictionTerm& term);

}  // namespace diffsim
