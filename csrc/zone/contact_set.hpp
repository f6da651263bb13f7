#pragma once

#include <vector>

#include "collision/candidates.hpp"
#include "contact/contact.hpp"
#include "zone/block_system.hpp"

/// The contacts of a zone: which features of which objects may push during the step, and by which laws.
namespace diffsim {

/// An object of a zone: a body, a cloth, or {kGround}.
struct ZoneObject {
    int body = kNobody;  ///< index into Zone::bodies
    int cloth = -1;      ///< index into Zone::cloths
};

/// Two objects of a zone, b maybe the ground, and their contacts, which follow each other.
struct ObjectPair {
    int object_a, object_b;  ///< numbered as in Model
    ZoneObject a, b;
    int first_contact;
    int first_law;   ///< of all its contacts, or of the first, where each has its own
    bool own_laws;   ///< of cloth, since features differ in mass; of contacts that were changed one by one
    int block = -1;  ///< of the Hessian where two bodies yield
};

/// Two features that may push each other.
struct FeatureContact : FeaturePair {
    int pair;  ///< index into ContactSet::pairs
};
static_assert(sizeof(FeatureContact) == 16, "a large zone has a hundred thousand of them");

/// A contact of a set, looked up.
struct ZoneContact {
    Contact contact;
    int a, b;              ///< indices into Zone::bodies, kNobody for cloth; b is kGround with the ground
    int cloth_a, cloth_b;  ///< indices into Zone::cloths, -1 for others
    int block;             ///< of the Hessian where two bodies yield, or -1
    const ContactLaw& law;

    bool has_cloth() const { return cloth_a >= 0 || cloth_b >= 0; }
};

/// The vertices of bodies in features of their contacts with other objects. Most are in several: each is placed once.
struct FeatureVertices {
    struct Entry {
        int body, vertex;
    };
    std::vector<Entry> entries;
    std::vector<int> first;    ///< per body: its vertex v stands at first[body] + v of ZonePoint::vertices
    std::vector<char> listed;  ///< whether it stands there; only vertices in entries do
};

/// An exact contact that pushes, in one list as in the next.
struct ShiftedContact {
    Contact contact;
    double shift;  ///< ContactLaw::shift [m]
};

/// What contacts keep while a zone is solved, however often they are listed anew; see zone/contact_memory.hpp.
struct ContactMemory {
    double compliance = 0.0;              ///< of contacts that are listed: rounds of multipliers may stiffen them
    bool rescued = false;                 ///< ranges are widened where objects start the step next to their pole
    std::vector<ShiftedContact> shifted;  ///< sorted
};

struct ContactSet {
    std::vector<ObjectPair> pairs;
    std::vector<FeatureContact> contacts;
    std::vector<ContactLaw> laws;
    FeatureVertices vertices;
    IndexPairs blocks;  ///< of dynamic bodies with contacts
    ContactMemory memory;
    bool with_friction = false;  ///< some contact has any

    std::size_t size() const { return contacts.size(); }
    bool empty() const { return contacts.empty(); }
    ZoneContact operator[](std::size_t k) const {
        const FeatureContact& f = contacts[k];
        const ObjectPair& pair = pairs[f.pair];
        return {
            {pair.object_a, pair.object_b, f.type, f.feature_a, f.feature_b},
            pair.a.body,
            pair.b.body,
            pair.a.cloth,
            pair.b.cloth,
            pair.block,
            laws[law_index(k, pair)]};
    }
    const ContactLaw& law(std::size_t k) const { return laws[law_index(k, pairs[contacts[k].pair])]; }

    /// Remove all but the memory.
    void clear();
    /// Append a contact; it has the law of those of the same two objects before it, or else `laws` has
    /// to receive its own. True if so.
    bool append(const Contact& contact, ZoneObject a, ZoneObject b, bool own_law);
    /// Let every contact have a law of its own, in the order of the contacts.
    void split_laws();

    class Iterator {
    public:
        Iterator(const ContactSet& set, std::size_t k) : m_set(&set), m_k(k) {}
        ZoneContact operator*() const { return (*m_set)[m_k]; }
        Iterator& operator++() {
            ++m_k;
            return *this;
        }
        bool operator!=(const Iterator& other) const { return m_k != other.m_k; }

    private:
        const ContactSet* m_set;
        std::size_t m_k;
    };
    Iterator begin() const { return {*this, 0}; }
    Iterator end() const { return {*this, size()}; }

private:
    static std::size_t law_index(std::size_t k, const ObjectPair& pair) {
        const std::size_t first = static_cast<std::size_t>(pair.first_law);
        return pair.own_laws ? first + k - static_cast<std::size_t>(pair.first_contact) : first;
    }
};

}  // namespace diffsim
