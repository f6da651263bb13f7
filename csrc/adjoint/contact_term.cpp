#include "adjoint/contact_term.hpp"

namespace diffsim {
namespace {

class ContactTermMaker {
public:
    ContactTermMaker(const Zone& zone, const ZonePoint& point) : m_zone(zone), m_point(point) {}

    ContactTerm operator()(const ActiveContact& active, Curvature curvature) const {
        const ZoneContact& contact = m_zone.contacts[active.index];
        ContactTerm term;
        if (contact.contact.with_ground()) {
            term.side_count = 1;
            if (contact.cloth_a >= 0)
                node_on_ground(contact, active, term);
            else
                body_on_ground(contact, active, term);
            return term;
        }
        if (contact.cloth_a >= 0)
            fill(
                contact, active, curvature, cloth(contact, active, true, term), cloth(contact, active, false, term),
                term);
        else if (contact.cloth_b >= 0)
            fill(contact, active, curvature, body(contact.a, 0, term), cloth(contact, active, false, term), term);
        else
            fill(contact, active, curvature, body(contact.a, 0, term), body(contact.b, 1, term), term);
        return term;
    }

private:
    BodySide body(int index, std::size_t side, ContactTerm& term) const {
        term.sides[side].body = index;
        return {m_point.poses[index].t};
    }
    ClothSide cloth(const ZoneContact& contact, const ActiveContact& active, bool of_a, ContactTerm& term) const {
        term.sides[of_a ? 0 : 1].nodes = feature_nodes(m_zone, contact, of_a);
        const Surface surface = of_a ? surface_a(m_zone, contact, m_point.poses, m_point.nodes)
                                     : surface_b(m_zone, contact, m_point.poses, m_point.nodes);
        return cloth_side(contact.contact, active.geometry, surface, of_a);
    }

    template <class A, class B>
    static void fill(
        const ZoneContact& contact, const ActiveContact& active, Curvature curvature, const A& a, const B& b,
        ContactTerm& term) {
        term.sides[1].offset = A::kSize;
        const bool with_hessian = curvature != Curvature::none;
        const auto d =
            contact_derivatives(active.geometry, contact.law, a, b, with_hessian, curvature != Curvature::dropped);
        term.row = d.row;
        term.gradient = d.gradient;
        if (with_hessian) term.hessian = d.hessian;
        term.stiffness = d.stiffness;
    }

    void body_on_ground(const ZoneContact& contact, const ActiveContact& active, ContactTerm& term) const {
        term.sides[0].body = contact.a;
        term.row = GroundContacts::row(active.geometry.closest.point_a - m_point.poses[contact.a].t);
        term.stiffness = normal_force(contact.law, active.geometry.distance).stiffness;
    }

    void node_on_ground(const ZoneContact& contact, const ActiveContact& active, ContactTerm& term) const {
        term.sides[0].nodes = feature_nodes(m_zone, contact, true);
        const PotentialValue potential = normal_force(contact.law, active.geometry.distance);
        term.row = Vec3::UnitZ();
        term.gradient = -potential.force * term.row;
        term.hessian = potential.stiffness * term.row * term.row.transpose();
        term.stiffness = potential.stiffness;
    }

    const Zone& m_zone;
    const ZonePoint& m_point;
};

}  // namespace

ContactTerm contact_term(const Zone& zone, const ZonePoint& point, const ActiveContact& active, Curvature curvature) {
    return ContactTermMaker(zone, point)(active, curvature);
}

}  // namespace diffsim
