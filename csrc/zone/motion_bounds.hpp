#pragma once

#include "zone/sides_of.hpp"

/// Bounds on how far things move when the coordinates of a zone change, cheap enough to ask before anything exact.
namespace diffsim {

/// How far a vertex of a body at most moves when the body's coordinates change by this much, chord or arc.
double motion_bound(const Vec6& change, double radius);

/// Bound on how far the arc of a vertex leaves its chord over this turn.
double sagitta(const Vec6& change, double radius);

/// Mean motion of a cloth's nodes between two places.
Vec3 mean_motion(const ZoneCloth& cloth, int count, const Coordinates& begin, const Coordinates& end);

/// How much nearer features of the zone may come between two places. What a cloth does as a whole brings none of its
/// features together.
class MotionBounds {
public:
    MotionBounds(const Zone& zone, const Coordinates& begin, const Coordinates& end);

    /// Contacts of the same two objects stand one after the other: of bodies the bound is found once for all of them.
    double approach(const ZoneContact& contact) {
        if (contact.has_cloth()) return approach_of_cloth(contact);
        if (contact.a != m_last_a || contact.b != m_last_b) {
            m_last_a = contact.a;
            m_last_b = contact.b;
            m_last = body(contact.a) + (contact.contact.with_ground() ? 0.0 : body(contact.b));
        }
        return m_last;
    }

private:
    double body(int index) const;
    double approach_of_cloth(const ZoneContact& contact) const;
    double of(const SideOfBody& side, bool self) const;
    double of(const SideOfCloth& side, bool self) const;
    static double of(const SideOfGround&, bool) { return 0.0; }

    const Zone& m_zone;
    const Coordinates &m_begin, &m_end;
    std::vector<double> m_nodes, m_uneven;
    int m_last_a = kNobody, m_last_b = kNobody;
    double m_last = 0.0;
};

}  // namespace diffsim
