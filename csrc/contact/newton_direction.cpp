#include "contact/newton_direction.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

namespace diffsim {
namespace {

constexpr CutShare kSmallestCut = 1.0 / 256.0;
constexpr CutShare kFirstCut = 1.0 / 16.0;  // where the exact Hessian is found to be indefinite
constexpr double kCutFactor = 4.0;
constexpr int kMaxDropped = 20;        // steps without the contacts' curvature: a landing takes fewer
constexpr double kUnsettling = 1e-10;  // of the largest force: as little as the tolerance lets pass

void set_to_descent(const Zone& zone, const ZoneDerivatives& derivatives, Coordinates& step) {
    step.resize(static_cast<std::size_t>(zone.dynamic_count), zone.nodes.size());
    for (int i = 0; i < zone.dynamic_count; ++i) step.bodies[i] = -derivatives.gradient.bodies[i];
    for (int i = 0; i < zone.node_count(); ++i) step.nodes[i] = -derivatives.gradient.nodes[i];
}

bool solve(const BlockSystem& system, Coordinates& step) {
    system.solve_in_place(step);
    for (const Vec6& s : step.bodies)
        if (!s.allFinite()) return false;
    for (const Vec3& s : step.nodes)
        if (!s.allFinite()) return false;
    return true;
}

bool has_driven_bodies(const Zone& zone) {
    return std::any_of(zone.bodies.begin() + zone.dynamic_count, zone.bodies.end(), [](const ZoneBody& body) {
        return !body.target.isZero(0.0);
    });
}

/// Push every body in a direction of its own, that nothing but its id decides. Where the Hessian is indefinite the
/// zone may be on a saddle of its energy. Rounding leads away from it, but where bodies stand in a regular pattern it
/// does so at the pattern's ends only, and the others follow one by one.
void unsettle(const Zone& zone, double force, Coordinates& step) {
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        std::minstd_rand random(static_cast<std::uint32_t>(body.id) + 1);
        random.discard(1);
        const double scale = force * std::sqrt(body.mass);
        for (int k = 3; k < 6; ++k)
            step.bodies[i][k] += scale * (2.0 * static_cast<double>(random()) / std::minstd_rand::max() - 1.0);
    }
}

}  // namespace

bool NewtonDirection::compute(
    const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system, Coordinates& step) {
    const bool bodies_alone = zone.nodes.empty();
    if (!(bodies_alone ? factorize_bodies(zone, point, derivatives, system)
                       : factorize_with_cloth(zone, point, derivatives, system)))
        return false;
    set_to_descent(zone, derivatives, step);
    if (bodies_alone && !m_is_exact) unsettle(zone, kUnsettling * derivatives.largest_force, step);
    return solve(system, step);
}

bool NewtonDirection::repeat(
    const Zone& zone, const ZoneDerivatives& derivatives, const BlockSystem& system, Coordinates& step) const {
    set_to_descent(zone, derivatives, step);
    return solve(system, step);
}

/// Where the exact Hessian is not positive definite, without the contacts' curvature: next to their stiffness and to the
/// bodies' inertia its positive part is mostly nothing, and costs eigenvalues of every pair. But some heaps need it, and
/// bodies that are being pressed on. Where it is indefinite it mostly is so for some steps: every other one does not look.
bool NewtonDirection::factorize_bodies(
    const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system) {
    const bool may_drop = m_dropped < kMaxDropped && !has_driven_bodies(zone);
    const bool try_exact = m_try_exact || !may_drop;
    m_is_exact = m_has_factor = false;
    if (try_exact) {
        differentiate(zone, point, Curvature::full, derivatives, &system);
        m_is_exact = m_has_factor = system.factorize();
    }
    m_try_exact = m_is_exact || !try_exact;
    if (m_is_exact) return true;
    if (may_drop) {
        ++m_dropped;
        differentiate(zone, point, Curvature::dropped, derivatives, &system);
    } else {
        differentiate(zone, point, Curvature::full, derivatives, &system, kAllCut);
    }
    m_has_factor = system.factorize();
    return m_has_factor;
}

/// Cut off no more negative curvature than needed, since it is what a sheet follows when it buckles: the share that it
/// takes is searched from one step to the next.
bool NewtonDirection::factorize_with_cloth(
    const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system) {
    bool failed = false;
    for (;;) {
        differentiate(zone, point, Curvature::full, derivatives, &system, m_cut);
        m_is_exact = m_cut == kNothingCut;
        m_has_factor = system.factorize();
        if (m_has_factor) break;
        if (m_cut == kAllCut) return false;
        failed = true;
        m_cut = m_cut == kNothingCut ? kFirstCut : std::min(kCutFactor * m_cut, kAllCut);
    }
    if (!failed) {
        m_cut /= kCutFactor;
        if (m_cut < kSmallestCut) m_cut = kNothingCut;
    }
    return true;
}

}  // namespace diffsim
