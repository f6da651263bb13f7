#pragma once

#include "zone/zone.hpp"

/// A zone at some coordinates.
namespace diffsim {

/// A contact below its rest distance.
struct ActiveContact {
    ActiveContact(int k, const Contact& contact, const Surface& a, const Surface& b, double ground_height)
        : index(k), geometry(contact, a, b, ground_height) {}

    int index;  ///< into Zone::contacts
    ContactGeometry geometry;
};

/// The zone at some coordinates: poses, distances, energy.
struct ZonePoint {
    Coordinates y;
    std::vector<Pose> poses;
    std::vector<Vec3> nodes;        ///< positions, zone frame
    std::vector<Vec3> vertices;     ///< of bodies, zone frame; those of ContactSet::vertices
    std::vector<double> distances;  ///< one per contact; beyond its rest distance maybe a lower bound [m]
    std::vector<ActiveContact> active;
    double energy = 0.0;          ///< infinite at or below a pole
    double contact_energy = 0.0;  ///< the contacts' part
    double elastic_energy = 0.0;  ///< the cloths' part, dt² Ψ
};

/// Find the rest of a point from its coordinates. `before`: a point that was evaluated with the same list of contacts,
/// or null. Pairs that cannot have come near since then are left out, with what is known of their distances.
void evaluate(const Zone& zone, ZonePoint& point, const ZonePoint* before = nullptr);

/// Where bodies and nodes are at these coordinates.
void place(const Zone& zone, const Coordinates& y, std::vector<Pose>& poses, std::vector<Vec3>& nodes);

/// The geometry of a contact where bodies and nodes are at these places.
ContactGeometry contact_geometry(
    const Zone& zone, const ZoneContact& contact, const std::vector<Pose>& poses, const std::vector<Vec3>& nodes);

}  // namespace diffsim
