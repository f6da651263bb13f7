#include "zone/motion_bounds.hpp"

#include <algorithm>

namespace diffsim {

double motion_bound(const Vec6& change, double radius) {
    return change.tail<3>().norm() + std::min(change.head<3>().norm(), 2.0) * radius;
}

double sagitta(const Vec6& change, double radius) {
    const double angle = change.head<3>().norm();
    return radius * std::min(0.125 * angle * angle, 2.0);
}

Vec3 mean_motion(const ZoneCloth& cloth, int count, const Coordinates& begin, const Coordinates& end) {
    Vec3 sum = Vec3::Zero();
    for (int i = cloth.first_node; i < cloth.first_node + count; ++i) sum += end.nodes[i] - begin.nodes[i];
    return sum / count;
}

MotionBounds::MotionBounds(const Zone& zone, const Coordinates& begin, const Coordinates& end)
    : m_zone(zone), m_begin(begin), m_end(end) {
    for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c) {
        const int first = zone.cloths[c].first_node, count = zone.cloth(c).node_count();
        const Vec3 mean = mean_motion(zone.cloths[c], count, begin, end);
        for (int i = first; i < first + count; ++i) {
            const Vec3 change = end.nodes[i] - begin.nodes[i];
            m_nodes.push_back(change.norm());
            m_uneven.push_back((change - mean).norm());
        }
    }
}

double MotionBounds::body(int index) const {
    return motion_bound(m_end.bodies[index] - m_begin.bodies[index], m_zone.mesh(index).radius);
}

double MotionBounds::approach_of_cloth(const ZoneContact& contact) const {
    const bool self = contact.contact.object_a == contact.contact.object_b;
    return with_sides(
        m_zone, contact, [&](const auto& a, const auto& b) -> double { return of(a, self) + of(b, self); });
}

double MotionBounds::of(const SideOfBody& side, bool) const { return body(side.body()); }

double MotionBounds::of(const SideOfCloth& side, bool self) const {
    double bound = 0.0;
    for (int node : side.nodes())
        if (node >= 0) bound = std::max(bound, (self ? m_uneven : m_nodes)[node]);
    return bound;
}

}  // namespace diffsim
