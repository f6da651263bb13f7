#pragma once

#include <optional>
#include <vector>

#include "zone/friction_row.hpp"
#include "zone/zone_contacts.hpp"
#include "zone/zone_derivatives.hpp"

/// The minimisation of a zone's energy over one step.
namespace diffsim {

class Interrupt;

enum class StepStatus {
    converged,
    too_many_iterations,
    crawls,      ///< of friction: more factorizations than steps that converge take
    no_descent,  ///< the line search found no lower energy
    spinning,    ///< a body turns further than its free motion can be solved for; never of a zone
    blocked,     ///< a driven body cannot reach its target: something is squeezed
    bad_start,   ///< objects at or below their pole at the start of the step
    overflow,    ///< a motion is too large for numbers to hold; never of a zone
};

struct ZoneOptions {
    double tolerance = 1e-10;  ///< on the residual
    int max_iterations = 200;
    /// Take this many full Newton steps, whether or not they lower the energy: for a zone without bodies and contacts,
    /// whose pinned nodes are at their targets from the first. Once from rest is Eq. 3 of [Qiao et al. 2020].
    std::optional<int> full_steps;
    Interrupt* interrupt = nullptr;  ///< may be asked between iterations: whoever waits for a long zone may have gone
    bool is_substep = false;         ///< see Options
};

struct ZoneResult {
    StepStatus status = StepStatus::converged;
    int iterations = 0;      ///< Newton steps
    double residual = 0.0;   ///< largest |L⁻¹ g| of a body, M = L Lᵀ, relative to the largest contact force
    int fast_impacts = 0;    ///< pairs of bodies with a fast ImpactGate
    int worst_contact = -1;  ///< for bad_start and blocked: index into Zone::contacts, or -1
};

/// Scratch that keeps its memory from zone to zone.
struct ZoneWorkspace {
    ZonePoint point, trial;
    ZoneDerivatives derivatives, trial_derivatives;
    BlockSystem system;
    ContactCoverage coverage;
    Coordinates step, y_end;
    std::vector<double> pushed;             ///< sum of the contact forces on each body
    std::vector<ContactFriction> friction;  ///< one per active contact of the point; empty where a zone has none
};

/// Minimise the zone's energy from y = 0, every iterate penetration-free: by one convex model of all near contacts
/// after the other, the last steps by Newton's method, as docs/solver.md describes. On return workspace.point is the
/// last iterate: the minimiser, or if the status says so the last penetration-free point before failure. `swept`, one
/// box per dynamic body, receives the space swept by the bodies' vertices in the zone frame.
ZoneResult solve_zone(
    Zone& zone, const PassiveBodies& passive, const ZoneOptions& options, ZoneWorkspace& workspace,
    std::vector<Box>& swept);

}  // namespace diffsim
