#pragma once

#include "zone/zone_contacts.hpp"

/// Which side of each other two bodies have to stay on during a step.
///
/// Iterates are free of penetration one after the other, and may all the same lead around an obstacle that is small
/// against the motion of one step; behind it the energy is as low as if it were not there. To the user that is passing
/// through. So the first impact of two bodies on the straight way to their targets is remembered: their points that met
/// there may pass each other along the normal by sliding or rolling off, but not by more than a part of the smaller
/// body. Where bodies spin, they may be past each other at the start: it counts from there. It does not hold for the
/// next step, by which fast bodies may have come around each other.
namespace diffsim {

struct ImpactGate {
    int a, b;               ///< bodies of the zone
    Vec3 point_a, point_b;  ///< that meet, body frames
    Vec3 normal;            ///< from b to a, zone frame
    double least_points;    ///< distance of the points along it that is still on their side [m]
    double least_centers;   ///< of the centres of mass, past which bodies turn as well [m]
    bool fast;              ///< they would move against each other by three quarters of the smaller's size or more
};

/// Whether some body moves so far, for the size of the smallest, that two may have gates. Cheap.
bool may_pass(const Zone& zone, const Coordinates& y_end);

/// The gates of a step from an evaluated point to y_end. Bodies that move little for their size have none.
std::vector<ImpactGate> find_impact_gates(const Zone& zone, const ZonePoint& point, const Coordinates& y_end);

/// Whether all pairs are on their side.
bool gates_hold(const std::vector<ImpactGate>& gates, const Zone& zone, const Coordinates& y);

}  // namespace diffsim
