#include "solve/newton_direction.hpp"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <random>

namespace diffsim {
namespace {

constexpr int kSaddleIterations = 8;  // of the power method: what is unstable has outgrown the rest

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

}  // namespace

bool NewtonDirection::compute(
    const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system, Coordinates& step) {
    const bool bodies_alone = zone.nodes.empty();
    if (!(bodies_alone ? factorize_bodies(zone, point, derivatives, system)
                       : factorize_with_cloth(zone, point, derivatives, system)))
        return false;
    set_to_descent(zone, derivatives, step);
    return solve(system, step);
}

bool NewtonDirection::repeat(
    const Zone& zone, const ZoneDerivatives& derivatives, const BlockSystem& system, Coordinates& step) const {
    set_to_descent(zone, derivatives, step);
    return solve(system, step);
}

/// Where the exact Hessian is not positive definite, without the negative curvature of every pair.
bool NewtonDirection::factorize_bodies(
    const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system) {
    differentiate(zone, point, Curvature::full, derivatives, &system);
    m_is_exact = m_has_factor = system.factorize();
    if (m_is_exact) return true;
    if (!m_exact) m_exact = std::make_unique<BlockSystem>();
    m_exact->set_pattern(system.pattern());
    m_exact->copy_values(system);
    differentiate(zone, point, Curvature::full, derivatives, &system, kAllCut);
    m_has_factor = system.factorize();
    return m_has_factor;
}

/// With A the exact Hessian and B the one at hand, A without its negative part pair by pair: the eigenvectors
/// of B⁻¹ (B - A) with values above 1 are directions of negative curvature, and iterating v -> v - B⁻¹ A v
/// lets these grow. They begin all together, in a direction that nothing but the bodies' ids decides, so that
/// what is symmetric leaves as one.
bool NewtonDirection::off_saddle(
    const Zone& zone, const ZoneDerivatives& derivatives, const BlockSystem& system, Coordinates& step) {
    const std::size_t count = static_cast<std::size_t>(zone.dynamic_count);
    step.assign_zero(count, 0);
    for (std::size_t i = 0; i < count; ++i) {
        std::minstd_rand random(static_cast<std::uint32_t>(zone.bodies[i].id) + 1);
        random.discard(1);
        for (int k = 0; k < 6; ++k) {
            const double radius = k < 3 ? zone.mesh(static_cast<int>(i)).radius : 1.0;
            step.bodies[i][k] = (2.0 * static_cast<double>(random()) / std::minstd_rand::max() - 1.0) / radius;
        }
    }
    Coordinates curved;
    double curvature = 0.0, slope = 0.0;
    for (int k = 0; k < kSaddleIterations; ++k) {
        m_exact->multiply(step, curved);
        curvature = slope = 0.0;
        for (std::size_t i = 0; i < count; ++i) {
            curvature += step.bodies[i].dot(curved.bodies[i]);
            slope += step.bodies[i].dot(derivatives.gradient.bodies[i]);
        }
        if (k + 1 == kSaddleIterations) break;
        if (!solve(system, curved)) return false;
        for (std::size_t i = 0; i < count; ++i) step.bodies[i] -= curved.bodies[i];
    }
    if (slope > 0.0)
        for (Vec6& s : step.bodies) s = -s;
    return curvature < 0.0;
}

bool NewtonDirection::factorize_with_cloth(
    const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system) {
    bool failed = false;
    for (;;) {
        differentiate(zone, point, Curvature::full, derivatives, &system, m_cut.share());
        m_is_exact = m_cut.share() == kNothingCut;
        m_has_factor = system.factorize();
        if (m_has_factor) break;
        if (!m_cut.more()) return false;
        failed = true;
    }
    if (!failed) m_cut.less();
    return true;
}

}  // namespace diffsim
