#pragma once

#include "contact/friction.hpp"
#include "zone/zone_derivatives.hpp"

/// Backward of a zone: implicit differentiation of its optimality condition dE/dy = 0, not of the iterations.
///
/// With upstream gradient v of y, H z = v gives d(loss)/d(parameter) = -zᵀ d(dE/dy)/d(parameter). Three ways to z,
/// so that their error and cost can be compared [Qiao et al. 2020, section 6]:
///  * exact: H is the energy's Hessian at the solution.
///  * dense: contacts are rows J of constant direction; the whole KKT system of Eq. 9, with the compliance as its
///    lower right block, by dense LU.
///    Elasticity keeps its exact Hessian: only contacts are linearised.
///  * qr: the same linear system through the pivoted QR of (stiffness^½ J L⁻ᵀ)ᵀ, M = L Lᵀ, as in Eq. 13-15.
namespace diffsim {

/// What of a gradient is asked for. The rest is left at zero, and not computed where that saves anything.
struct GradientNeeds {
    bool place = true;     ///< of where objects start a step, and of what moves them: velocities and drives
    bool mass = true;      ///< of bodies, or density of cloths
    bool inertia = true;   ///< of bodies
    bool material = true;  ///< stretch, shear, bend and damping of cloths
};

struct ZoneAdjoint {
    Coordinates multiplier;  ///< z, one per dynamic body and node; zero at pinned nodes
    /// Through contacts and elasticity, when an object starts elsewhere and moves as it did: one per body of the zone,
    /// those that do not yield included, along its twist at the end of the step; one per node.
    Coordinates pose_gradient;
    /// Through slips and strains between start and end, when what moves as told goes further and ends where it did: one
    /// per body that does not yield and pinned node, along its motion.
    Coordinates drive_gradient;
    /// Of one object's coefficient of friction, through one contact.
    struct FrictionPart {
        int object;  ///< numbered as Parameters::friction
        double value;
    };
    std::vector<FrictionPart> friction_gradient;
    std::vector<Vec3> start_gradient;             ///< one per node: through the strains that damping is measured from
    std::vector<Vec3> first_stage_gradient;       ///< one per node: of Straining::first_stage
    std::vector<double> mass_gradient;            ///< through the contacts' stiffness, one per dynamic body
    std::vector<double> node_mass_gradient;       ///< the same, one per node
    std::vector<ClothParameters> cloth_gradient;  ///< through elasticity, one per cloth of the zone
};

/// Memory that adjoints reuse, their results included.
struct AdjointWorkspace {
    BlockSystem system;
    ZoneDerivatives derivatives;
    std::vector<Vec6> twist;  ///< z of each body, its turn along the twist at the end of the step
    ZoneAdjoint result;
};

/// `zone.contacts` need hold the active contacts only; `point` is the zone evaluated at the solution.
/// `friction`: of the active contacts, empty in a zone without; in mode exact only, and not of exact contacts.
/// `upstream` has one entry per dynamic body and node; those of pinned nodes are not used. The result is the
/// workspace's, until its next use.
const ZoneAdjoint& zone_adjoint(
    const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>& friction, const Coordinates& upstream,
    AdjointMode mode, const GradientNeeds& needs, AdjointWorkspace& workspace);

}  // namespace diffsim
