#pragma once

#include <cstdint>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "adjoint/adjoint.hpp"
#include "adjoint/linearised_zone.hpp"
#include "dynamics/free_motion.hpp"
#include "model/state.hpp"
#include "parallel/interrupt.hpp"
#include "parallel/workers.hpp"
#include "solve/zone_solver.hpp"
#include "step/step_setting.hpp"
#include "step/touching_zones.hpp"

/// One time step and its backward: the only place that knows the whole order.
///
/// With implicit Euler a step is one solve: y is the minimiser of [zone/zone.hpp] for targets ŷ = dt v̂, v̂
/// the velocity at the end of free motion, and the new velocities are y / dt. The scheme of second order has, of bodies
/// that move by the trapezoidal rule, two solves from the same start:
///  * velocities: that of implicit Euler, whose y / dt are the new velocities, so that contact is inelastic, what rests
///    has none, and momentum is kept among bodies in contact;
///  * places: targets ŷ = dt (v0 + v̂) / 2, bodies of double weight. What contact does to places is then dt² f / (2 m),
///    as what gravity does is dt² g / 2; forces, and compressions at rest, are those of the other solve.
/// Cloth moves by two stages (dynamics/two_stages.hpp). The first is a step of implicit Euler over γ dt of all that may
/// meet cloth, its contacts as stiff as in the others; the second is solved with the bodies, once for velocities and
/// once for places, and has the forces of cloth alone from the first: those of contact it finds again, or an impact in
/// the first stage would bounce in the second.
namespace diffsim {

/// What the backward of a step needs: O(bodies + contacts).
struct StepRecord {
    SceneState start;
    bool held = false;                        ///< nothing moved, see hold(); the rest is empty
    std::vector<FreeRotation> free_rotation;  ///< one per body
    Coordinates y;                            ///< the motion of the step: (turn, shift) per body, shift per node
    std::vector<Vec3> elastic_shift;          ///< per node: its motion without contact; with split coupling only
    TouchingZones zones;
    std::vector<Vec3>
        first_stage;  ///< per node: where it was at the end of the first stage; empty where there was none
    // Of a time scheme that has several parts; this one is of the places then.
    std::unique_ptr<StepRecord> velocities, stage;
    // Of a step that was taken in shorter ones: how often dt was halved for this one, and the one after it.
    int halvings = 0;
    std::unique_ptr<StepRecord> next;

    std::size_t bytes() const;
};

struct StepInfo {
    bool converged = true;
    StepStatus status = StepStatus::converged;  ///< of the first zone that did not converge
    int contacts = 0;
    int sticking = 0, slipping = 0;  ///< of those with friction
    int zones = 0;                   ///< groups of bodies and cloths in contact
    int largest_zone = 0;            ///< bodies and cloths
    int iterations = 0;              ///< Newton steps of the zone that took most
    double residual = 0.0;
    double max_compression = 0.0;  ///< of a contact below its rest distance [m]
    int fast_impacts = 0;          ///< pairs of bodies with a fast ImpactGate
    double seconds_motion = 0.0, seconds_broad_phase = 0.0, seconds_zones = 0.0;
    int substeps = 1;                 ///< that the step was taken in, which it is where it is not found at once
    std::uint64_t signature = 0;      ///< hash of the active contacts and their types
    std::vector<int> failed_objects;  ///< bodies and cloths of what did not converge, ascending

    /// Let it speak of another solve's effort, too: counts of contacts and what became of them are not added.
    void add_effort(const StepInfo& other);
};

/// Objects penetrate in the state a step was to start from; says which.
class PenetratingStart : public std::invalid_argument {
public:
    PenetratingStart(const std::string& text, int object_a, int object_b)
        : std::invalid_argument(text), a(object_a), b(object_b) {}

    int a, b;  ///< b may be kGround
};

/// What it takes to solve a zone.
struct ZoneMemory {
    Zone zone;
    ZoneWorkspace workspace;
    std::vector<Box> swept;
};

struct ThreadMemory;

/// Memory that steps reuse, and the threads among which a step divides its bodies and zones. No result depends on their
/// number. Serves one step at a time.
class StepWorkspace {
public:
    explicit StepWorkspace(int thread_count = 1);
    ~StepWorkspace();
    StepWorkspace(const StepWorkspace&) = delete;
    StepWorkspace& operator=(const StepWorkspace&) = delete;

    /// A thread's own memory. The thread itself must be the first to ask for it: it is made there, and given back there
    /// when the thread ends. An allocator hands out what a thread gives back to that thread again, so
    /// memory that another one has given back lies among what that one writes to, and two threads wait for
    /// the same cache lines all the time.
    ThreadMemory& memory(int thread = 0);
    /// Call visit(memory) for the threads that have some.
    template <class Visit>
    void for_each_memory(const Visit& visit) {
        for (const std::unique_ptr<ThreadMemory>& memory : m_memory)
            if (memory) visit(*memory);
    }

    struct ForwardScratch;
    std::unique_ptr<ForwardScratch> forward;
    struct BackwardScratch;
    std::shared_ptr<BackwardScratch> backward;  ///< made by the first backward
    Interrupt* interrupt = nullptr;             ///< of the computation that steps are part of, if it has one

private:
    std::vector<std::unique_ptr<ThreadMemory>> m_memory;

public:
    Workers workers;  ///< the last member: its threads use the others as long as they run
};

/// From how many bodies on loops that do little for each are shared among threads, and in what portions.
inline constexpr int kBodiesARange = 128;

/// Advance by options.dt, in shorter steps where one is not found. `record`, if given, receives what step_backward
/// needs; it does not change the result. Throws PenetratingStart if objects penetrate at the start. Where motions are
/// too large for numbers to hold, all is held.
SceneState step(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
    const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record);

/// What takes the place of a step that cannot be taken because of these objects: the
/// state, unchanged and not converged.
SceneState hold(
    const SceneState& state, StepStatus status, std::vector<int> objects, StepInfo& info, StepRecord* record);

/// Carry the gradient at the end of a step back to its start. `gradient` is overwritten; control and parameter
/// gradients are added to. What `needs` does not ask for is incomplete.
void step_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient);

/// Of a step, the record and the options of the last of the shorter ones it was taken in, or its own.
const StepRecord& last_part(const StepRecord& record, Options& options);

/// The linear systems of adjoint modes dense and qr, one per zone of a step.
std::vector<LinearisedZone> linearised_zones(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record);

}  // namespace diffsim
