#include "solve/zone_search.hpp"

#include <algorithm>
#include <cmath>
#include <utility>

namespace diffsim {
namespace {

constexpr int kMaxStalls = 3;    // steps in a row that get a driven body nowhere
constexpr double kStall = 1e-3;  // of the way that is left

}  // namespace

void ZoneSearch::accept_trial() {
    std::swap(m_work.point, m_work.trial);
    mark_swept();
}

void ZoneSearch::mark_swept() {
    for (int i = 0; i < m_zone.dynamic_count; ++i)
        m_swept[i].include(transformed(m_zone.mesh(i).tree.nodes[0].box, m_work.point.poses[i]));
    for (int c = 0; c < static_cast<int>(m_zone.cloths.size()); ++c) {
        Box& box = m_swept[static_cast<std::size_t>(m_zone.dynamic_count + c)];
        const int first = m_zone.cloths[c].first_node;
        for (int i = first; i < first + m_zone.cloth(c).node_count(); ++i) box.include(m_work.point.nodes[i]);
    }
}

bool ZoneSearch::drives_done() const {
    for (int i = m_zone.dynamic_count; i < m_zone.body_count(); ++i)
        if (m_work.point.y.bodies[i] != m_zone.bodies[i].target) return false;
    for (int i = 0; i < m_zone.node_count(); ++i)
        if (m_zone.nodes[i].pinned && m_work.point.y.nodes[i] != m_zone.nodes[i].target) return false;
    return true;
}

ZoneSearch::DriveProgress ZoneSearch::advance_drives(double step, int& stalls) {
    stalls = step < kStall ? stalls + 1 : 0;
    if (stalls > kMaxStalls) return DriveProgress::blocked;
    return step > 0.0 && m_path.clear_step(m_work.y_end) > 0.0 ? DriveProgress::moved : DriveProgress::waits;
}

/// Where nothing pushes, a contact within rounding of its rest distance may be found to push or not.
Accuracy ZoneSearch::current_accuracy() {
    double& stiffness = m_work.derivatives.largest_stiffness;
    for (std::size_t k = 0; m_work.point.active.empty() && k < m_zone.contacts.size(); ++k) {
        const ZoneContact& contact = m_zone.contacts[k];
        if (m_work.point.distances[k] > contact.law.range.rest + 16.0 * kEpsilon * m_path.position()) continue;
        for (int body : {contact.a, contact.b})
            if (m_zone.yields(body))
                stiffness = std::max(stiffness, contact.law.stiffness.value / std::sqrt(m_zone.bodies[body].mass));
    }
    return accuracy(m_zone, m_work.derivatives, m_path.position());
}

double ZoneSearch::current_noise() {
    return energy_noise(m_zone, m_work.point, m_work.system, m_path.position(), m_work.pushed);
}

}  // namespace diffsim
