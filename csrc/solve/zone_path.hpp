#pragma once

#include <vector>

#include "solve/impact_gate.hpp"
#include "zone/zone_contacts.hpp"

/// Ways of a zone, and the contacts that are listed for them.
namespace diffsim {

/// Where a zone may go from its current point: the list of its contacts is made complete for the ways that are asked
/// about, and these end before impacts and gates. Trials are points on such ways.
class ZonePath {
public:
    /// The zone begins without contacts. All of them are used, and the zone's contacts, `point`, `trial` and `coverage`
    /// changed, for as long as this lives. `system` gets the pattern of the contacts.
    ZonePath(
        Zone& zone, const PassiveBodies& passive, ZonePoint& point, ZonePoint& trial, ContactCoverage& coverage,
        BlockSystem& system);

    /// Size of the numbers that distances are differences of [m].
    double position() const { return m_position; }

    void set_to_targets(Coordinates& y_end) const;

    // --- contacts. Where they are listed anew, the current point is evaluated again, but by list_contacts().

    /// List contacts for the way from the current point to y_end.
    void list_contacts(Coordinates& y_end);
    /// Make the list complete for a step to y_end; true if it had to be made anew.
    bool ensure_covered(Coordinates& y_end);
    /// How often contacts were listed: lists with the same number are the same.
    int list_number() const { return m_list_number; }
    bool covers(const Coordinates& y_end) const { return is_covered(m_zone, m_coverage, y_end); }
    /// Some objects start the step below their floor: widen the range of their contacts, here and in all lists to come.
    void rescue();
    /// Let the forces of exact contacts act at their rest distances; see diffsim::shift_contacts.
    void shift_contacts(double stiffening);

    // --- gates

    /// Set those of the way to y_end. Returns how many are of fast bodies.
    int set_gates(const Coordinates& y_end);
    /// Whether a body has a gate of fast bodies, and whether a contact is of two with one.
    bool is_fast(int body) const;
    bool is_fast(const ZoneContact& contact) const;
    bool gates_hold(const Coordinates& y) const { return diffsim::gates_hold(m_gates, m_zone, y); }

    // --- steps

    /// Let the trial's coordinates be this part of the way to y_end.
    void set_trial(const Coordinates& y_end, double step);
    /// Evaluate the trial at the longest allowed part of the way to y_end. A shortened arc is not on the chord that was
    /// checked, so it is checked again. 0 if no part is allowed.
    double clear_step(const Coordinates& y_end, Clearance clearance = Clearance::floor);
    /// Shorten a step until the chords to its end are clear.
    double arc_step(const Coordinates& y_end, double step);
    /// The allowed step to y_end, with the list of contacts complete for it. `known`: how
    /// much is free for those listed.
    double covered_step(Coordinates& y_end, double known = 0.0);

private:
    Zone& m_zone;
    const PassiveBodies& m_passive;
    ZonePoint &m_point, &m_trial;
    ContactCoverage& m_coverage;
    BlockSystem& m_system;
    std::vector<ImpactGate> m_gates;
    double m_position = 0.0;
    int m_list_number = 0;
};

}  // namespace diffsim
