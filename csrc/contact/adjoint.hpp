#pragma once

#include "contact/zone.hpp"

/// Backward of a zone: implicit differentiation of its optimality condition dE/dy = 0, not of the iterations.
///
/// With upstream gradient v of y, H z = v gives d(loss)/d(parameter) = -zᵀ d(dE/dy)/d(parameter). Three ways to z,
/// so that their error and cost can be compared [Qiao et al. 2020, section 6]:
///  * exact: H is the energy's Hessian at the solution.
///  * dense: contacts are rows J of constant direction; the whole KKT system of Eq. 9, with the compliance as its
///    lower right block, by dense LU.
///  * qr: the same linear system through the pivoted QR of (stiffness^½ J L⁻ᵀ)ᵀ, M = L Lᵀ, as in Eq. 13-15.
namespace diffsim {

struct ZoneAdjoint {
    Coordinates multiplier;  ///< z, one per dynamic body
    /// Through the contacts, one per body of the zone, those that do not yield included: gradient along the twist of
    /// the body at the end of the step when its base pose moves.
    std::vector<Vec6> pose_gradient;
    std::vector<double> mass_gradient;  ///< through the contacts' stiffness, one per dynamic body
};

/// `zone.contacts` need hold the active contacts only; `point` is the zone evaluated at the solution.
ZoneAdjoint zone_adjoint(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, AdjointMode mode, BlockSystem& system);

}  // namespace diffsim
