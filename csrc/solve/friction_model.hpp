#pragma once

#include "solve/contact_model.hpp"

/// The model of a zone with friction: where the forces of all near contacts are in balance.
///
/// With force_r = stiffness max(0, missing - rowᵀ p) the rows' forces, a contact that slips by s(p) is held by
///     f = μ force u,   u = w / max(|w|, reach),   w = s(p) + reach · multiplier,
/// which is Coulomb's law but for the slip that a sticking contact has against its multiplier; that of the next model
/// takes it over. The bound follows the force inside the model, so that this is no minimum: the solution of
///     H p + g - Σ force row + Σ rows_s μ force u = 0
/// is found by Newton's method, whose matrix S - N is not symmetric: S is what it is for bounds that stay as they
/// are, N what they change by. GMRES with the factor of S solves with it, and with what S leaves out of contacts
/// that turn.
namespace diffsim {

/// What a model with friction is asked for.
struct BalanceGoal {
    double tolerance = 0.0;  ///< of its balance, in units of |L⁻¹ g|
    /// Contacts mostly go on as in the last model: those that slip in a direction that is made exact. Compressed ones
    /// have their stiffness, not the secant's.
    bool is_settled = false;
    bool turns = false;        ///< what rows do not see of contacts is in the model, too; see FrictionTurns
    bool is_balanced = false;  ///< only slips of sticking contacts are left to end
    bool may_crawl = true;     ///< a model that is not solved to its end is of use
    bool bounds_stay = false;  ///< FrictionRow::bound and ::reach are given: a convex minimisation
};

// How far slips reach, of what a bound presses its contact by: see FrictionRow::reach.
inline constexpr double kColdShare = 0.5;
inline constexpr double kSlipShare = 0.07;     ///< near the balance
inline constexpr double kHoldingShare = 2e-3;  ///< and where only slips of sticking contacts are left to end

/// Memory of balance(), kept from model to model.
struct BalanceWorkspace {
    Coordinates smooth_p, gradient, step, smooth_step;
    std::vector<double> violation, slope, bound;
    std::vector<char> pushes;
    std::vector<Vec2> slip, slip_step, pull;
    std::vector<Vec2> along_step;  // as slip_step, without turns: what forces act along
    SideMatrices turned;
};

/// Solve it. `p` holds the start, which pinned nodes keep, and receives the solution; rows receive their forces and
/// states. Scratch: `system`, whose pattern is that of model.smooth.
ModelSolution balance(
    ContactModel& model, const Zone& zone, const BalanceGoal& goal, BlockSystem& system, BalanceWorkspace& workspace,
    Coordinates& p);

}  // namespace diffsim
