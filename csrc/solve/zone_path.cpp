#include "solve/zone_path.hpp"

#include <algorithm>
#include <cmath>

#include "zone/contact_memory.hpp"
#include "zone/zone_derivatives.hpp"

namespace diffsim {
namespace {

constexpr int kMaxCuts = 50;
constexpr double kBeforeImpact = 1.0 - 1e-6;  // of the way to an impact: there rounding finds it once more
constexpr double kArcPart = 0.9;              // of an arc whose chord is not clear

}  // namespace

ZonePath::ZonePath(
    Zone& zone, const PassiveBodies& passive, ZonePoint& point, ZonePoint& trial, ContactCoverage& coverage,
    BlockSystem& system)
    : m_zone(zone), m_passive(passive), m_point(point), m_trial(trial), m_coverage(coverage), m_system(system) {
    forget_contacts(zone);
    m_coverage.strays.clear();
}

void ZonePath::set_to_targets(Coordinates& y_end) const {
    for (std::size_t i = 0; i < y_end.bodies.size(); ++i) y_end.bodies[i] = m_zone.bodies[i].target;
    for (std::size_t i = 0; i < y_end.nodes.size(); ++i) y_end.nodes[i] = m_zone.nodes[i].target;
}

void ZonePath::list_contacts(Coordinates& y_end) {
    collect_contacts(m_zone, m_passive, m_point.y, y_end, m_coverage);
    recall_contacts(m_zone);
    m_position = m_zone.model->thickness;
    if (m_zone.model->ground.present) m_position = std::max(m_position, std::abs(m_zone.ground_height));
    for (int i = 0; i < m_zone.body_count(); ++i) {
        const ZoneBody& body = m_zone.bodies[i];
        m_position = std::max(m_position, body.start.t.cwiseAbs().maxCoeff() + m_zone.mesh(i).radius);
    }
    for (const ZoneNode& node : m_zone.nodes) m_position = std::max(m_position, node.start.cwiseAbs().maxCoeff());
    m_system.set_pattern(base_pattern(m_zone));
    ++m_list_number;
}

bool ZonePath::ensure_covered(Coordinates& y_end) {
    if (covers(m_point.y) && covers(y_end)) return false;
    list_contacts(y_end);
    evaluate(m_zone, m_point);
    return true;
}

void ZonePath::rescue() {
    rescue_contacts(m_zone);
    evaluate(m_zone, m_point);
}

void ZonePath::shift_contacts(double stiffening) {
    diffsim::shift_contacts(m_zone, m_point, stiffening);
    evaluate(m_zone, m_point);
}

int ZonePath::set_gates(const Coordinates& y_end) {
    m_gates = find_impact_gates(m_zone, m_point, y_end);
    return static_cast<int>(
        std::count_if(m_gates.begin(), m_gates.end(), [](const ImpactGate& gate) { return gate.fast; }));
}

bool ZonePath::is_fast(int body) const {
    return std::any_of(
        m_gates.begin(), m_gates.end(), [&](const ImpactGate& gate) { return gate.a == body || gate.b == body; });
}

bool ZonePath::is_fast(const ZoneContact& contact) const {
    if (contact.contact.with_ground() || contact.has_cloth()) return false;
    return std::any_of(m_gates.begin(), m_gates.end(), [&](const ImpactGate& gate) {
        return gate.fast && gate.a == contact.a && gate.b == contact.b;
    });
}

void ZonePath::set_trial(const Coordinates& y_end, double step) {
    const Coordinates& y = m_point.y;
    m_trial.y.resize(y_end.bodies.size(), y_end.nodes.size());
    for (std::size_t i = 0; i < y_end.bodies.size(); ++i)
        m_trial.y.bodies[i] = y.bodies[i] + step * (y_end.bodies[i] - y.bodies[i]);
    for (std::size_t i = 0; i < y_end.nodes.size(); ++i)
        m_trial.y.nodes[i] = y.nodes[i] + step * (y_end.nodes[i] - y.nodes[i]);
}

double ZonePath::clear_step(const Coordinates& y_end, Clearance clearance) {
    double step = 1.0;
    m_trial.y = y_end;
    for (int k = 0; k < kMaxCuts; ++k) {
        const double allowed = allowed_step(m_zone, m_point, m_trial.y, nullptr, clearance);
        if (allowed == 1.0 && gates_hold(m_trial.y)) {
            evaluate(m_zone, m_trial, &m_point);
            if (m_trial.energy < kInfinity) return step;
        }
        step *= allowed < 1.0 ? kBeforeImpact * allowed : 0.5;
        set_trial(y_end, step);
    }
    return 0.0;
}

double ZonePath::arc_step(const Coordinates& y_end, double step) {
    for (int k = 0; k < kMaxCuts && step > 0.0; ++k) {
        m_trial.y = y_end;
        if (step < 1.0) set_trial(y_end, step);
        const double allowed = allowed_step(m_zone, m_point, m_trial.y, nullptr);
        if (allowed == 1.0 && gates_hold(m_trial.y)) return step;
        step *= std::min(allowed, kArcPart);
    }
    return 0.0;
}

double ZonePath::covered_step(Coordinates& y_end, double known) {
    const bool listed_anew = ensure_covered(y_end);
    if (!listed_anew && known == 1.0 && gates_hold(y_end)) return 1.0;
    return arc_step(y_end, 1.0);
}

}  // namespace diffsim
