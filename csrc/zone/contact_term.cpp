#include "zone/contact_term.hpp"

namespace diffsim {
namespace {

template <class A, class B>
void fill(
    const ContactLaw& law, const ContactGeometry& geometry, Curvature curvature, const PlacedSide<A>& a,
    const PlacedSide<B>& b, ContactTerm& term) {
    set_side(term.sides[0], a);
    set_side(term.sides[1], b);
    term.sides[1].offset = A::kSize;
    const bool with_hessian = curvature != Curvature::none;
    const auto d = contact_derivatives(geometry, law, a.side, b.side, with_hessian, curvature != Curvature::dropped);
    term.row = d.row;
    term.gradient = d.gradient;
    if (with_hessian) term.hessian = d.hessian;
    term.stiffness = d.stiffness;
}

void fill(
    const ContactLaw& law, const ContactGeometry& geometry, Curvature, const PlacedSide<BodySide>& a,
    const PlacedSide<GroundSide>&, ContactTerm& term) {
    term.side_count = 1;
    set_side(term.sides[0], a);
    term.row = GroundSums::row(geometry.closest.a.point - a.side.center);
    term.stiffness = normal_force(law, geometry.distance).stiffness;
}

void fill(
    const ContactLaw& law, const ContactGeometry& geometry, Curvature, const PlacedSide<ClothSide>& a,
    const PlacedSide<GroundSide>&, ContactTerm& term) {
    term.side_count = 1;
    set_side(term.sides[0], a);
    const PotentialValue potential = normal_force(law, geometry.distance);
    term.row = Vec3::UnitZ();
    term.gradient = -potential.force * term.row;
    term.hessian = potential.stiffness * term.row * term.row.transpose();
    term.stiffness = potential.stiffness;
}

}  // namespace

ContactTerm contact_term(const Zone& zone, const ZonePoint& point, const ActiveContact& active, Curvature curvature) {
    const ZoneContact& contact = zone.contacts[active.index];
    ContactTerm term;
    with_placed_sides(zone, contact, active.geometry, point.poses, point.nodes, [&](const auto& a, const auto& b) {
        fill(contact.law, active.geometry, curvature, a, b, term);
    });
    return term;
}

}  // namespace diffsim
