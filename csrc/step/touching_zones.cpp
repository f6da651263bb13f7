#include "step/touching_zones.hpp"

#include <utility>

namespace diffsim {
namespace {

/// From sizes to where each part begins; returns the sum.
int to_offsets(std::vector<int>& sizes) {
    int sum = 0;
    for (int& size : sizes) sum += std::exchange(size, sum);
    return sum;
}

/// The object by which a contact's zone is found.
int yielding_object(const Model& model, const Contact& contact) {
    return model.yields(contact.object_a) ? contact.object_a : contact.object_b;
}

template <class Visit>
void for_each_contact(const std::vector<ContactList>& lists, const Visit& visit) {
    for (const ContactList& list : lists)
        for (int k = 0; k < list.count; ++k) visit(list.contacts[k], list, k);
}

}  // namespace

std::size_t TouchingZones::bytes() const {
    return contacts.capacity() * sizeof(Contact) + exact.capacity() * sizeof(ExactContact) +
           friction.capacity() * sizeof(ContactFriction) +
           (bodies.capacity() + cloths.capacity() + body_end.capacity() + cloth_end.capacity() +
            contact_end.capacity()) *
               sizeof(int);
}

void ZoneFinder::unite(
    const Model& model, const std::vector<int>& movers, const std::vector<ContactList>& lists, bool one_zone) {
    const int object_count = model.body_count() + model.cloth_count();
    m_touching.reset(object_count);
    m_zone_of.assign(static_cast<std::size_t>(object_count), -1);
    for (int c = model.body_count(); c < object_count; ++c) m_zone_of[c] = 0;
    if (one_zone) {
        for (int i : movers) {
            m_zone_of[i] = 0;
            m_touching.unite(movers[0], i);
        }
    }
    for_each_contact(lists, [&](const Contact& c, const ContactList&, int) {
        const bool a_yields = model.yields(c.object_a), b_yields = model.yields(c.object_b);
        if (a_yields) m_zone_of[c.object_a] = 0;
        if (b_yields) m_zone_of[c.object_b] = 0;
        if (a_yields && b_yields) m_touching.unite(c.object_a, c.object_b);
    });
}

/// By their smallest objects; how many bodies and cloths each has stands at their ends.
void ZoneFinder::number(const Model& model, const std::vector<int>& movers, TouchingZones& zones) {
    zones.body_end.clear();
    zones.cloth_end.clear();
    for (int i : movers) {
        if (m_zone_of[i] < 0) continue;
        const int root = m_touching.find(i);
        if (root == i) {
            m_zone_of[i] = zones.count();
            zones.body_end.push_back(0);
            zones.cloth_end.push_back(0);
        } else {
            m_zone_of[i] = m_zone_of[root];
        }
        ++(model.is_cloth(i) ? zones.cloth_end : zones.body_end)[m_zone_of[i]];
    }
}

void ZoneFinder::find(
    const Model& model, const std::vector<int>& movers, const std::vector<ContactList>& lists, const Wanted& wanted,
    TouchingZones& zones) {
    unite(model, movers, lists, wanted.one_zone);
    number(model, movers, zones);
    // Objects and contacts, sorted by zone.
    zones.contact_end.assign(zones.body_end.size(), 0);
    for_each_contact(lists, [&](const Contact& c, const ContactList&, int) {
        ++zones.contact_end[m_zone_of[yielding_object(model, c)]];
    });
    zones.bodies.resize(static_cast<std::size_t>(to_offsets(zones.body_end)));
    zones.cloths.resize(static_cast<std::size_t>(to_offsets(zones.cloth_end)));
    zones.contacts.resize(static_cast<std::size_t>(to_offsets(zones.contact_end)));
    zones.exact.resize(wanted.exact ? zones.contacts.size() : 0);
    for (int i : movers) {
        if (m_zone_of[i] < 0) continue;
        if (model.is_cloth(i))
            zones.cloths[zones.cloth_end[m_zone_of[i]]++] = i - model.body_count();
        else
            zones.bodies[zones.body_end[m_zone_of[i]]++] = i;
    }
    zones.friction.resize(wanted.friction ? zones.contacts.size() : 0);
    for_each_contact(lists, [&](const Contact& c, const ContactList& list, int k) {
        const int slot = zones.contact_end[m_zone_of[yielding_object(model, c)]]++;
        zones.contacts[slot] = c;
        if (wanted.exact) zones.exact[slot] = list.exact[k];
        if (wanted.friction) zones.friction[slot] = list.friction[k];
    });
}

}  // namespace diffsim
