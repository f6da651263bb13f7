#pragma once

#include <vector>

#include "contact/friction.hpp"
#include "math/union_find.hpp"
#include "model/model.hpp"

/// Zones as a step leaves them: of what really touches, where before there were groups of what might meet.
namespace diffsim {

/// Dynamic bodies in contact and all cloths, zone after zone, and the active contacts of each zone: what the backward
/// solves together. Zones are in the order of their smallest objects, bodies before cloths.
struct TouchingZones {
    std::vector<int> bodies, cloths;
    std::vector<Contact> contacts;
    std::vector<ExactContact> exact;                    ///< one per contact; empty when contacts give way
    std::vector<ContactFriction> friction;              ///< one per contact; empty in scenes without
    std::vector<int> body_end, cloth_end, contact_end;  ///< of each zone in the lists above

    int count() const { return static_cast<int>(body_end.size()); }
    std::size_t bytes() const;
};

/// Active contacts of one group.
struct ContactList {
    const Contact* contacts;
    const ExactContact* exact;
    const ContactFriction* friction;
    int count;
};

/// Makes zones from contacts; keeps its memory.
class ZoneFinder {
public:
    /// What zones are to be made of beside bodies, cloths and contacts.
    struct Wanted {
        bool exact = false;     ///< TouchingZones::exact
        bool friction = false;  ///< TouchingZones::friction
        bool one_zone = false;  ///< all that yields in one
    };
    /// `movers` are the dynamic bodies and the cloths, sorted.
    void find(
        const Model& model, const std::vector<int>& movers, const std::vector<ContactList>& lists, const Wanted& wanted,
        TouchingZones& zones);

private:
    void unite(
        const Model& model, const std::vector<int>& movers, const std::vector<ContactList>& lists, bool one_zone);
    void number(const Model& model, const std::vector<int>& movers, TouchingZones& zones);

    UnionFind m_touching;
    std::vector<int> m_zone_of;  // per object, -1 in none
};

}  // namespace diffsim
