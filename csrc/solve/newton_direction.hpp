#pragma once

#include <memory>

#include "solve/cut_search.hpp"
#include "zone/zone_derivatives.hpp"

/// The direction of a zone near its solution.
namespace diffsim {

/// Newton steps of a zone, one after the other, and the factor that the last of them came from.
class NewtonDirection {
public:
    /// Derivatives at the point and the Newton step from there: by the exact Hessian where that is positive definite,
    /// else without some of its negative curvature. False if rounding spoils even that.
    bool compute(
        const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system, Coordinates& step);
    /// The step that the last factor, still in the system, gives for a new gradient.
    bool repeat(
        const Zone& zone, const ZoneDerivatives& derivatives, const BlockSystem& system, Coordinates& step) const;

    /// After compute(), where bodies' exact Hessian was not positive definite: a direction of negative curvature that
    /// does not lead up. False if none was found.
    bool off_saddle(const Zone& zone, const ZoneDerivatives& derivatives, const BlockSystem& system, Coordinates& step);

    bool has_factor() const { return m_has_factor; }
    /// Whether it is that of the exact Hessian.
    bool is_exact() const { return m_is_exact; }
    /// Something else has been factorized in the system.
    void lose_factor() { m_has_factor = false; }

private:
    bool factorize_bodies(const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system);
    bool factorize_with_cloth(
        const Zone& zone, const ZonePoint& point, ZoneDerivatives& derivatives, BlockSystem& system);

    CutSearch m_cut;
    std::unique_ptr<BlockSystem> m_exact;  // the Hessian that was not positive definite, once there was one
    bool m_has_factor = false;
    bool m_is_exact = false;
};

}  // namespace diffsim
