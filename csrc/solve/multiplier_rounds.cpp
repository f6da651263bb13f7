#include "solve/multiplier_rounds.hpp"

#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

constexpr double kSlowRound = 0.1;          // of what was left of a violation: stiffer contacts leave less
constexpr double kStiffening = 10.0;        // of contacts, after a slow round
constexpr double kLeastCompliance = 1e-10;  // of contacts that were stiffened

}  // namespace

double MultiplierRounds::violation(const Zone& zone, const ZonePoint& point, double position) {
    double violation = 0.0;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ContactLaw& law = zone.contacts.law(k);
        const double compression = std::max(law.range.rest - point.distances[k], 0.0);
        const double distance = std::abs(compression - law.shift);
        if (distance > 16.0 * kEpsilon * position)
            violation = std::max(violation, distance / (law.range.rest - law.shift - law.range.floor));
    }
    return violation;
}

double MultiplierRounds::stiffening(const Zone& zone, double violation) {
    const bool slow = violation > kSlowRound * m_left && zone.contacts.memory.compliance > kLeastCompliance;
    m_left = violation;
    return slow ? kStiffening : 1.0;
}

}  // namespace diffsim
