#pragma once

#include "zone/zone_point.hpp"

/// Multipliers of exact contacts.
namespace diffsim {

/// Rounds of the method of multipliers, for a zone of exact contacts: after each, the rest distance of every contact is
/// shifted so that its force acts with no compression (shift_contacts).
///
/// Every round leaves 1 / (1 + k s) of the compression, k the stiffness and s what a force moves the contact by: about
/// the compliance where masses decide that. It is more under a heavy body that rests on several light ones, and where
/// a force on curved contacts makes s negative a round may even overshoot. There contacts become stiffer.
class MultiplierRounds {
public:
    /// How far contacts that push are from their rest distance, of their range. What rounding does to it is not
    /// counted; `position`: size of the numbers that distances are differences of [m].
    static double violation(const Zone& zone, const ZonePoint& point, double position);

    /// How many times stiffer contacts become in the next round: more than 1 where the last one left much of what the
    /// one before had. `violation` is what is left now.
    double stiffening(const Zone& zone, double violation);

private:
    double m_left = kInfinity;  // of the violation, a round ago
};

}  // namespace diffsim
