#pragma once

#include "zone/zone_point.hpp"

/// The listing of the contacts that a motion of a zone may bring about, and how far a motion may go.
namespace diffsim {

/// Which part of its motion a zone's list of contacts is complete for: all coordinates within `slack` of the segment
/// from `begin` to `end`.
struct ContactCoverage {
    Coordinates begin, end;
    std::vector<double> slack;        ///< one per dynamic body [m]
    std::vector<double> cloth_slack;  ///< one per cloth, for each of its nodes [m]
    std::vector<char> strays;         ///< dynamic bodies whose ways have left a list; empty before the first list

    /// Memory that listing reuses.
    struct Scratch {
        std::vector<SweptMesh> meshes;
        std::vector<Box> boxes;
        std::vector<SweptBoxes> feature_boxes;
        std::vector<int> vertices;
        std::vector<FeaturePair> features;
    } scratch;
};

/// The distance at which the two features of a contact rest: the sum of their margins. Features of one cloth may be
/// nearer at rest than its thickness: there they keep half of that.
double contact_margins(const Model& model, const Contact& contact);

/// Append a contact between two objects of the zone with its range and stiffness; its
/// block of the Hessian is left open.
void add_contact(Zone& zone, const Contact& contact, ZoneObject a, ZoneObject b);

/// List the zone's contacts, of cloths with themselves too, for motions along the segment from `begin` to `end` and
/// somewhat around it. Bodies of
/// `passive` that come near join the zone. `begin` and `end` are extended where bodies join. `coverage` is overwritten.
void collect_contacts(
    Zone& zone, const PassiveBodies& passive, Coordinates& begin, Coordinates& end, ContactCoverage& coverage);

/// Whether the list is complete at these coordinates.
bool is_covered(const Zone& zone, const ContactCoverage& coverage, const Coordinates& y);

/// A contact hit on the way.
struct Impact {
    int contact;
    double toi;  ///< in [0, 1] of the motion
};

/// What a motion keeps pairs above: the floor, or the distance at which impacts land, where contacts hardly push.
enum class Clearance { floor, landing };

/// How far the zone may go from an evaluated point towards y_end, vertices on straight lines, before some pair comes
/// to its clearance, or nearer if it is below that already; at most 1. `impacts`, if given, receives the pairs that do,
/// in the order of the contacts.
double allowed_step(
    const Zone& zone, const ZonePoint& point, const Coordinates& y_end, std::vector<Impact>* impacts,
    Clearance clearance = Clearance::floor);

}  // namespace diffsim
