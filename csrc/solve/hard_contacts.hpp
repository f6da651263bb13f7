#pragma once

#include <vector>

#include "zone/zone.hpp"

namespace diffsim {

/// Multipliers of a zone's hard contacts [the method of multipliers]: the rest distance of each is shifted so that its force
/// acts with no compression.
///
/// Every round leaves 1 / (1 + k s) of the compression, k the stiffness and s what a force moves the contact by: about
/// the compliance where masses decide that. It is more under a heavy body that rests on several light ones, and where
/// a force on curved contacts makes s negative a round may even overshoot. There contacts become stiffer.
class HardContacts {
public:
    /// How far contacts that push are from their rest distance, of their range. What rounding does to it is not counted;
    /// `position`: size of the numbers that distances are differences of [m].
    static double violation(const Zone& zone, const ZonePoint& point, double position);

    /// Let every contact's force act at its rest distance, and stiffen contacts where the last round left much of what the
    /// one before had: `violation` is what is left now.
    void shift(Zone& zone, const ZonePoint& point, double violation);

    /// Contacts that were listed anew push as before.
    void restore(Zone& zone) const;

private:
    struct Shifted {
        Contact contact;
        double shift;

        bool operator<(const Shifted& other) const;
    };
    std::vector<Shifted> m_shifted;  // those that push, sorted
    double m_left = kInfinity;       // of the violation, a round ago
};

}  // namespace diffsim
