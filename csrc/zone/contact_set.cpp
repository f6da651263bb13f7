#include "zone/contact_set.hpp"

namespace diffsim {

void ContactSet::clear() {
    with_friction = false;
    pairs.clear();
    contacts.clear();
    laws.clear();
    blocks.clear();
    vertices.entries.clear();
    vertices.first.clear();
    vertices.listed.clear();
}

bool ContactSet::append(const Contact& contact, ZoneObject a, ZoneObject b, bool own_law) {
    const bool known = !pairs.empty() && pairs.back().object_a == contact.object_a &&
                       pairs.back().object_b == contact.object_b && pairs.back().own_laws == own_law;
    if (!known)
        pairs.push_back(
            {contact.object_a, contact.object_b, a, b, static_cast<int>(contacts.size()), static_cast<int>(laws.size()),
             own_law});
    contacts.push_back({{contact.type, contact.feature_a, contact.feature_b}, static_cast<int>(pairs.size()) - 1});
    return !known || own_law;
}

void ContactSet::split_laws() {
    std::vector<ContactLaw> own;
    own.reserve(contacts.size());
    for (std::size_t k = 0; k < contacts.size(); ++k) own.push_back(law(k));
    laws = std::move(own);
    for (ObjectPair& pair : pairs) {
        pair.own_laws = true;
        pair.first_law = pair.first_contact;
    }
}

}  // namespace diffsim
