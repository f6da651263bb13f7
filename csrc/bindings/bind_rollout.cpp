#include <pybind11/stl.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <stdexcept>
#include <tuple>

#include "bindings/bindings.hpp"
#include "bindings/rollout_arrays.hpp"
#include "bindings/signals.hpp"

namespace diffsim::bindings {
namespace {

struct Rollout {
    py::tuple trajectory;
    std::shared_ptr<Tape> tape;
    RolloutInfo info;
    py::array_t<std::uint64_t> signature;
};

Rollout bound_rollout(
    const std::shared_ptr<Model>& model, const Options& options, const InputArrays& inputs, int steps,
    bool controls_have_time, bool keep_time, bool record, int num_threads, int first_step) {
    if (steps < 1) throw std::invalid_argument("steps must be at least 1");
    const Fields fields = input_fields(*model);
    const Leading leading = find_leading(inputs, fields, steps, controls_have_time);
    const RolloutInputs views = views_of(inputs, fields, leading);
    Rollout result{py::tuple(kStateCount), record ? std::make_shared<Tape>() : nullptr, {}, {}};
    TrajectoryArrays<double> trajectory;
    for (std::size_t k = 0; k < kStateCount; ++k) {
        result.trajectory[k] = py::none();
        if (kInputs[k].axis == Axis::nodes && model->cloths.empty()) continue;
        Array out(trajectory_shape(leading, keep_time, fields[k].core));
        trajectory[k] = trajectory_view(out.mutable_data(), leading, keep_time, fields[k].core);
        result.trajectory[k] = std::move(out);
    }
    const RolloutShape shape{
        steps, static_cast<int>(leading.batch), first_step, keep_time, controls_have_time, leading.has_batch};
    std::vector<std::uint64_t> signatures;
    Signals().watch([&](Interrupt* interrupt) {
        result.info =
            rollout(model, options, shape, views, trajectory, signatures, result.tape.get(), num_threads, interrupt);
    });
    Shape signature_shape = {leading.steps};
    if (leading.has_batch) signature_shape.push_back(leading.batch);
    result.signature = py::array_t<std::uint64_t>(signature_shape);
    std::memcpy(result.signature.mutable_data(), signatures.data(), signatures.size() * sizeof(std::uint64_t));
    return result;
}

bool all_within(const Array& array, double limit) {
    bool within = true;
    for (const double *x = array.data(), *end = x + array.size(); x != end; ++x) within &= std::abs(*x) <= limit;
    return within;
}

/// Raised with (scene, step, gradients, objects, nodes) of a GradientFault as its arguments.
PyObject* gradient_fault_type = nullptr;

[[noreturn]] void raise_fault(const GradientFault& fault) {
    const py::tuple arguments = py::make_tuple(fault.scene, fault.step, fault.gradients, fault.objects, fault.nodes);
    PyErr_SetObject(gradient_fault_type, arguments.ptr());
    throw py::error_already_set();
}

py::tuple bound_backward(
    const std::shared_ptr<Tape>& tape, const InputArrays& inputs, const OutputArrays& upstream,
    const std::array<bool, kInputCount>& needs, int num_threads, double limit) {
    const Fields fields = input_fields(*tape->model);
    const Leading leading = find_leading(inputs, fields, tape->shape.steps, tape->shape.controls_have_time);
    if (leading.batch != tape->shape.batch)
        throw std::invalid_argument("rollout_backward: inputs are not those of the forward");
    const RolloutInputs views = views_of(inputs, fields, leading);
    const bool keep_time = tape->shape.keep_time;

    TrajectoryArrays<const double> upstream_views;
    for (std::size_t k = 0; k < kStateCount; ++k) {
        if (!upstream[k]) continue;
        const Shape expected = trajectory_shape(leading, keep_time, fields[k].core);
        if (shape_of(*upstream[k]) != expected)
            throw std::invalid_argument(
                std::string("the gradient of ") + fields[k].name + " must have shape " + shape_text(expected) +
                ", got " + shape_text(shape_of(*upstream[k])));
        upstream_views[k] = trajectory_view(upstream[k]->data(), leading, keep_time, fields[k].core);
    }

    RolloutArrays<double> gradient;
    py::tuple result(fields.size());
    for (std::size_t k = 0; k < fields.size(); ++k) {
        result[k] = py::none();
        if (!needs[k] || !inputs[k]) continue;
        Array out(shape_of(*inputs[k]));
        std::fill_n(out.mutable_data(), out.size(), 0.0);
        gradient[k] = view_of(out.mutable_data(), fields[k], out.ndim(), leading);
        result[k] = std::move(out);
    }
    Signals().watch([&](Interrupt* interrupt) {
        rollout_backward(*tape, views, upstream_views, gradient, num_threads, interrupt);
    });
    std::vector<std::string> faulty;
    for (std::size_t k = 0; k < fields.size(); ++k)
        if (!result[k].is_none() && !all_within(py::cast<Array>(result[k]), limit)) faulty.push_back(fields[k].name);
    if (faulty.empty()) return result;
    std::optional<GradientFault> fault = find_gradient_fault(*tape, views, upstream_views, gradient, limit);
    if (!fault) return result;  // the caller's own: upstream is not finite
    if (fault->gradients.empty()) fault->gradients = std::move(faulty);
    raise_fault(*fault);
}

const char* name_of(InputKind kind) {
    constexpr const char* kNames[] = {"state", "control", "parameter"};
    return kNames[static_cast<int>(kind)];
}

const char* name_of(Axis axis) {
    constexpr const char* kNames[] = {"", "bodies", "nodes", "objects", "cloths"};
    return kNames[static_cast<int>(axis)];
}

const char* name_of(Allowed allowed) {
    constexpr const char* kNames[] = {"any", "positive", "not_negative"};
    return kNames[static_cast<int>(allowed)];
}

/// Without the state or the control that it is a field of.
std::string name_of_field(const Input& input) {
    const std::string label = input.label;
    return label.substr(label.find('.') + 1);
}

py::tuple row_axes(const Input& input) {
    const RowShape row = row_shape(input);
    py::tuple result(row.rank);
    for (int axis = 0; axis < row.rank; ++axis) result[axis] = row.axes[static_cast<std::size_t>(axis)];
    return result;
}

/// Why a step did not converge, or nothing.
const char* failure_text(StepStatus status) {
    switch (status) {
        case StepStatus::converged:
            return "";
        case StepStatus::too_many_iterations:
            return "max_iterations reached";
        case StepStatus::crawls:
            return "no balance of friction was found in thousands of factorizations";
        case StepStatus::no_descent:
            return "no step lowers the energy";
        case StepStatus::spinning:
            return "a body spins too fast";
        case StepStatus::blocked:
            return "a driven body is blocked: something is squeezed";
        case StepStatus::bad_start:
            return "objects penetrate at the start";
        case StepStatus::overflow:
            return "a motion is too large for numbers to hold";
    }
    return "";
}

/// The same as one word.
const char* status_text(StepStatus status) {
    switch (status) {
        case StepStatus::converged:
            return "converged";
        case StepStatus::too_many_iterations:
            return "max_iterations";
        case StepStatus::crawls:
            return "crawls";
        case StepStatus::no_descent:
            return "no_descent";
        case StepStatus::spinning:
            return "spinning";
        case StepStatus::blocked:
            return "blocked";
        case StepStatus::bad_start:
            return "penetrating";
        case StepStatus::overflow:
            return "overflow";
    }
    return "";
}

using FailureRow = std::tuple<int, int, std::vector<int>, std::string, std::string, int, double>;

std::vector<FailureRow> failures(const RolloutInfo& info) {
    std::vector<FailureRow> result;
    for (const FailedStep& failed : info.failures)
        result.emplace_back(
            failed.scene, failed.step, failed.objects, status_text(failed.status), failure_text(failed.status),
            failed.iterations, failed.residual);
    return result;
}

py::array_t<bool> scenes_converged(const RolloutInfo& info) {
    Shape shape;
    if (info.has_batch) shape.push_back(static_cast<py::ssize_t>(info.scenes_converged.size()));
    py::array_t<bool> result(shape);
    std::copy(info.scenes_converged.begin(), info.scenes_converged.end(), result.mutable_data());
    return result;
}

py::dict milliseconds(const RolloutInfo& info) {
    py::dict result;
    result["motion"] = 1e3 * info.last.seconds_motion;
    result["broad_phase"] = 1e3 * info.last.seconds_broad_phase;
    result["zones"] = 1e3 * info.last.seconds_zones;
    result["total"] = 1e3 * info.seconds;
    return result;
}

}  // namespace

void bind_rollout(py::module_& module) {
    gradient_fault_type = py::exception<GradientFault>(module, "GradientFault", PyExc_RuntimeError).release().ptr();

    py::class_<Input>(module, "Input", "A line of the table of inputs.")
        .def_property_readonly("label", [](const Input& input) { return input.label; })
        .def_property_readonly("name", &name_of_field)
        .def_property_readonly("kind", [](const Input& input) { return name_of(kind_of(input)); })
        .def_property_readonly("axis", [](const Input& input) { return name_of(input.axis); })
        .def_property_readonly("row_shape", &row_axes)
        .def_property_readonly("unit", [](const Input& input) { return input.unit; })
        .def_property_readonly("allowed", [](const Input& input) { return name_of(input.allowed); });

    module.def(
        "inputs", [] { return std::vector<Input>(std::begin(kInputs), std::end(kInputs)); },
        "What a rollout is given, in the order of its arguments.");

    py::class_<Tape, std::shared_ptr<Tape>>(module, "Tape", "What the backward of a rollout needs.")
        .def_property_readonly("nbytes", &Tape::bytes);

    py::class_<RolloutInfo>(module, "Info", "Statistics of a rollout; counts are those of its last step.")
        .def_readonly("converged", &RolloutInfo::converged)
        .def_readonly("failed_steps", &RolloutInfo::failed_steps)
        .def_readonly("refined_steps", &RolloutInfo::refined_steps)
        .def_readonly("fast_impacts", &RolloutInfo::fast_impacts)
        .def_property_readonly("failure", [](const RolloutInfo& info) { return failure_text(info.status); })
        .def_property_readonly("failures", &failures)
        .def_property_readonly("scenes_converged", &scenes_converged)
        .def_property_readonly("contacts", [](const RolloutInfo& info) { return info.last.contacts; })
        .def_property_readonly("sticking", [](const RolloutInfo& info) { return info.last.sticking; })
        .def_property_readonly("slipping", [](const RolloutInfo& info) { return info.last.slipping; })
        .def_property_readonly("zones", [](const RolloutInfo& info) { return info.last.zones; })
        .def_property_readonly("largest_zone", [](const RolloutInfo& info) { return info.last.largest_zone; })
        .def_property_readonly("iterations", [](const RolloutInfo& info) { return info.last.iterations; })
        .def_property_readonly("residual", [](const RolloutInfo& info) { return info.last.residual; })
        .def_property_readonly("max_compression", [](const RolloutInfo& info) { return info.last.max_compression; })
        .def_property_readonly("milliseconds", &milliseconds);

    py::class_<Rollout>(module, "Rollout", "Trajectory, tape and statistics.")
        .def_readonly("trajectory", &Rollout::trajectory)
        .def_readonly("tape", &Rollout::tape)
        .def_readonly("info", &Rollout::info)
        .def_readonly("signature", &Rollout::signature);

    module.def(
        "rollout", &bound_rollout, py::arg("model"), py::arg("options"), py::arg("inputs").noconvert(), py::kw_only(),
        py::arg("steps"), py::arg("controls_have_time"), py::arg("keep_time"), py::arg("record"),
        py::arg("num_threads"), py::arg("first_step"));

    module.def(
        "rollout_backward", &bound_backward, py::arg("tape"), py::arg("inputs").noconvert(),
        py::arg("upstream").noconvert(), py::kw_only(), py::arg("needs"), py::arg("num_threads"), py::arg("limit"),
        "Gradients of the inputs. Raises GradientFault where upstream is finite and some number is not, or larger than "
        "the limit.");
}

}  // namespace diffsim::bindings
