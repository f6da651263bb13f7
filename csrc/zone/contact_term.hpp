#pragma once

#include "zone/sides_of.hpp"
#include "zone/zone_derivatives.hpp"

/// The derivatives of one contact, by itself.
namespace diffsim {

/// Vectors and matrices of up to two features of cloth, on the stack.
using SmallVector = Eigen::Matrix<double, Eigen::Dynamic, 1, 0, 18, 1>;
using SmallMatrix = Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, 0, 18, 18>;

/// Call body_part(body, offset) and node_part(node, offset) for everything on the sides of a term.
template <class Side, class BodyPart, class NodePart>
void visit_sides(const std::array<Side, 2>& sides, int count, const BodyPart& body_part, const NodePart& node_part) {
    for (int s = 0; s < count; ++s) {
        const Side& side = sides[static_cast<std::size_t>(s)];
        if (side.body >= 0) {
            body_part(side.body, side.offset);
            continue;
        }
        for (int k = 0; k < 3; ++k) {
            const int node = side.nodes[static_cast<std::size_t>(k)];
            if (node >= 0) node_part(node, side.offset + 3 * k);
        }
    }
}

/// The derivatives of an active contact and what they are taken along: one or two objects, each a body's twist (6) or
/// the nodes of a cloth's feature (9).
struct ContactTerm {
    struct Side {
        int body = kNobody;
        std::array<int, 3> nodes = {-1, -1, -1};
        int offset = 0;
    };
    std::array<Side, 2> sides;
    int side_count = 2;
    SmallVector row, gradient;
    SmallMatrix hessian;
    double stiffness;

    /// Call body_part(body, offset) and node_part(node, offset) for everything the term is taken along.
    template <class BodyPart, class NodePart>
    void for_each(const BodyPart& body_part, const NodePart& node_part) const {
        visit_sides(sides, side_count, body_part, node_part);
    }
};

inline void set_side(ContactTerm::Side& side, const PlacedSide<BodySide>& placed) { side.body = placed.body; }
inline void set_side(ContactTerm::Side& side, const PlacedSide<ClothSide>& placed) { side.nodes = placed.nodes; }
inline void set_side(ContactTerm::Side&, const PlacedSide<GroundSide>&) {}

/// The coordinates of what a term is taken along; zero where it does not yield.
template <class Term>
SmallVector gather(const Zone& zone, const Term& term, const Coordinates& z) {
    const ContactTerm::Side& last = term.sides[static_cast<std::size_t>(term.side_count - 1)];
    SmallVector result = SmallVector::Zero(last.offset + (last.body >= 0 ? 6 : 9));
    term.for_each(
        [&](int body, int offset) {
            if (zone.yields(body)) result.segment<6>(offset) = z.bodies[body];
        },
        [&](int node, int offset) {
            if (!zone.nodes[node].pinned) result.segment<3>(offset) = z.nodes[node];
        });
    return result;
}

/// sum += factor * v, back where gather() takes it from.
template <class Term>
void scatter(const Zone& zone, const Term& term, double factor, const SmallVector& v, Coordinates& sum) {
    term.for_each(
        [&](int body, int offset) {
            if (zone.yields(body)) sum.bodies[body] += factor * v.segment<6>(offset);
        },
        [&](int node, int offset) {
            if (!zone.nodes[node].pinned) sum.nodes[node] += factor * v.segment<3>(offset);
        });
}

/// The derivatives of one active contact. Curvature::none leaves the Hessian unset, which of a body on the ground it
/// always is.
ContactTerm contact_term(const Zone& zone, const ZonePoint& point, const ActiveContact& active, Curvature curvature);

}  // namespace diffsim
