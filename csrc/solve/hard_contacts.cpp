#include "solve/hard_contacts.hpp"

#include <algorithm>
#include <cmath>
#include <tuple>

namespace diffsim {
namespace {

constexpr double kSlowRound = 0.1;          // of what was left of a violation: stiffer contacts leave less
constexpr double kStiffening = 10.0;        // of contacts, after a slow round
constexpr double kLeastCompliance = 1e-10;  // of contacts that were stiffened

}  // namespace

bool HardContacts::Shifted::operator<(const Shifted& other) const {
    const Contact &c = contact, &d = other.contact;
    return std::tie(c.object_a, c.object_b, c.type, c.feature_a, c.feature_b) <
           std::tie(d.object_a, d.object_b, d.type, d.feature_a, d.feature_b);
}

double HardContacts::violation(const Zone& zone, const ZonePoint& point, double position) {
    double violation = 0.0;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ContactRange& range = zone.contacts.law(k).range;
        const double shift = zone.contacts.law(k).shift;
        const double compression = std::max(range.rest - point.distances[k], 0.0);
        const double distance = std::abs(compression - shift);
        if (distance > 16.0 * kEpsilon * position)
            violation = std::max(violation, distance / (range.rest - shift - range.floor));
    }
    return violation;
}

void HardContacts::shift(Zone& zone, const ZonePoint& point, double violation) {
    const bool slow = violation > kSlowRound * m_left && zone.compliance > kLeastCompliance;
    const double stiffening = slow ? kStiffening : 1.0;
    m_left = violation;
    zone.compliance /= stiffening;
    m_shifted.clear();
    zone.contacts.split_laws();
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        ContactLaw& law = zone.contacts.laws[k];
        const double force = normal_force(law, point.distances[k]).force;
        law.stiffness.value *= stiffening;
        shift_rest(law, force);
        if (law.shift > 0.0) m_shifted.push_back({zone.contacts[k].contact, law.shift});
    }
    std::sort(m_shifted.begin(), m_shifted.end());
}

void HardContacts::restore(Zone& zone) const {
    if (m_shifted.empty()) return;
    zone.contacts.split_laws();
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const Shifted key{zone.contacts[k].contact, 0.0};
        const auto found = std::lower_bound(m_shifted.begin(), m_shifted.end(), key);
        if (found == m_shifted.end() || key < *found) continue;
        ContactLaw& law = zone.contacts.laws[k];
        law.shift = found->shift;
        law.range.rest += found->shift;
    }
}

}  // namespace diffsim
