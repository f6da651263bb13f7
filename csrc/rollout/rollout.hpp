#pragma once

#include <memory>
#include <optional>
#include <string>

#include "rollout/input_table.hpp"
#include "step/contact_readout.hpp"
#include "step/step.hpp"

/// Many steps of many scenes: the arrays of the Python layer in, the same out.
namespace diffsim {

/// A row-major array with an optional time and an optional batch axis in front; stride 0 where it lacks one.
template <typename T>
struct BatchedView {
    T* data = nullptr;                                 ///< null: not given
    std::ptrdiff_t time_stride = 0, batch_stride = 0;  ///< in numbers

    bool present() const { return data != nullptr; }
    T* at(int time, int scene) const { return data + time * time_stride + scene * batch_stride; }
};

/// The inputs of a rollout, or gradients of the same shapes, in the order of the table. All of
/// cloth is absent in scenes without.
template <typename T>
using RolloutArrays = std::array<BatchedView<T>, kInputCount>;
using RolloutInputs = RolloutArrays<const double>;

/// A trajectory, or the gradient with respect to one: the state's part of the table.
template <typename T>
using TrajectoryArrays = std::array<BatchedView<T>, kStateCount>;

struct RolloutShape {
    int steps = 1;
    int batch = 1;
    int first_step = 0;               ///< steps that other calls made before, from the state that the user gave
    bool keep_time = false;           ///< the trajectory has all steps, or the last state only
    bool controls_have_time = false;  ///< the controls' arrays have a time axis
    bool has_batch = false;           ///< arrays have a batch axis, if only one of size 1
};

/// What the backward of a rollout needs. Read only: any number of backwards may use it.
struct Tape {
    std::shared_ptr<const Model> model;
    Options options;
    RolloutShape shape;
    std::vector<std::vector<StepRecord>> records;  ///< [scene][step]

    std::size_t bytes() const;
};

/// A step that did not converge.
struct FailedStep {
    int scene = 0;
    int step = 0;  ///< of the whole rollout: steps that other calls made before count
    StepStatus status = StepStatus::converged;
    std::vector<int> objects;  ///< see StepInfo::failed_objects
    int iterations = 0;
    double residual = 0.0;
};

/// How many failed steps a call lists: what a reader, or a log, can take.
inline constexpr std::size_t kMaxFailures = 256;

struct RolloutInfo {
    bool converged = true;
    int failed_steps = 0;
    int refined_steps = 0;                      ///< that were taken in shorter ones
    int fast_impacts = 0;                       ///< of all steps
    StepStatus status = StepStatus::converged;  ///< of the first of `failures`
    std::vector<FailedStep> failures;           ///< the first kMaxFailures, by step, then scene
    std::vector<char> scenes_converged;         ///< all steps of each scene
    bool has_batch = false;                     ///< see RolloutShape
    StepInfo last;  ///< of the last step: counts summed over the batch, other numbers the largest
    double seconds = 0.0;
};

/// Advance `shape.batch` scenes by `shape.steps`, on up to `thread_count` threads; the result does not depend on it.
/// `signatures`, steps x batch, receives a hash of each step's active contacts. Throws std::invalid_argument on values
/// that make no sense, naming the body, node or cloth, the field and the value, and Interrupted if `interrupt` was
/// asked to stop, which is looked at before every step.
RolloutInfo rollout(
    const std::shared_ptr<const Model>& model, const Options& options, const RolloutShape& shape,
    const RolloutInputs& inputs, const TrajectoryArrays<double>& trajectory, std::vector<std::uint64_t>& signatures,
    Tape* tape, int thread_count, Interrupt* interrupt = nullptr);

/// d(loss)/d(inputs) from d(loss)/d(trajectory). `inputs` are those of the forward; gradient arrays that are present
/// are overwritten, the others cost nothing. Throws Interrupted as rollout() does.
void rollout_backward(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& gradient, int thread_count, Interrupt* interrupt = nullptr);

/// Where a gradient stopped being finite that was computed from finite ones.
struct GradientFault {
    int scene = -1, step = -1;           ///< -1: each step's is finite, their sum over steps and scenes is not
    std::vector<std::string> gradients;  ///< which, as in "state.velocity" (at the start of the step) or "mass"
    std::vector<int> objects;            ///< whose, ascending; empty for gravity's
    std::vector<int> nodes;              ///< of cloths, indices into the node axis
};

/// What to say of a backward that gave numbers larger than `limit` or not finite: the last step in which that happened,
/// of the first scene; nothing if upstream gradients are not finite to begin with. Runs the backward again.
std::optional<GradientFault> find_gradient_fault(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& wanted, double limit);

/// The linear systems of adjoint modes dense and qr in the last step of a scene. `inputs` are those of the forward.
std::vector<LinearisedZone> linearised_zones(const Tape& tape, const RolloutInputs& inputs, int scene);

/// What pushed in the last step of a scene. `inputs` are those of the forward.
std::vector<ContactReadout> last_contacts(const Tape& tape, const RolloutInputs& inputs, int scene);

}  // namespace diffsim
