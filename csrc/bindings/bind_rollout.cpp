#include <pybind11/stl.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstring>
#include <functional>
#include <initializer_list>
#include <numeric>
#include <stdexcept>
#include <tuple>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "scene_queries.hpp"

namespace diffsim::bindings {
namespace {

using Shape = std::vector<py::ssize_t>;

constexpr std::size_t kInputCount = 20, kOutputCount = 6;
using InputArrays = std::array<OptionalArray, kInputCount>;    // in the order of RolloutArrays
using OutputArrays = std::array<OptionalArray, kOutputCount>;  // in the order of TrajectoryArrays

/// The axes of an array behind time and batch. Without a heap: a call makes some twenty of them.
struct Core {
    std::array<py::ssize_t, 3> axes{};
    py::ssize_t rank = 0;

    Core(std::initializer_list<py::ssize_t> list) : rank(static_cast<py::ssize_t>(list.size())) {
        std::copy(list.begin(), list.end(), axes.begin());
    }
    const py::ssize_t* begin() const { return axes.data(); }
    const py::ssize_t* end() const { return axes.data() + rank; }
    py::ssize_t size() const { return std::accumulate(begin(), end(), py::ssize_t{1}, std::multiplies<py::ssize_t>()); }
};

/// One input's name and core shape.
struct Field {
    const char* name;
    Core core;
    bool is_control;  ///< may have a time axis, and may be missing
};
using Fields = std::array<Field, kInputCount>;

Fields input_fields(const Model& model) {
    const py::ssize_t n = model.body_count(), nodes = model.node_count(), cloths = model.cloth_count();
    return {
        {{"position", {n, 3}, false},
         {"orientation", {n, 4}, false},
         {"velocity", {n, 3}, false},
         {"angular_velocity", {n, 3}, false},
         {"node_position", {nodes, 3}, false},
         {"node_velocity", {nodes, 3}, false},
         {"force", {n, 3}, true},
         {"torque", {n, 3}, true},
         {"node_force", {nodes, 3}, true},
         {"body_velocity", {n, 3}, true},
         {"body_angular_velocity", {n, 3}, true},
         {"node_drive", {nodes, 3}, true},
         {"mass", {n}, false},
         {"inertia", {n, 3, 3}, false},
         {"gravity", {3}, false},
         {"cloth_density", {cloths}, false},
         {"cloth_stretch", {cloths}, false},
         {"cloth_shear", {cloths}, false},
         {"cloth_bend", {cloths}, false},
         {"cloth_damping", {cloths}, false}}};
}

template <typename T>
std::array<BatchedView<T>*, kInputCount> members(RolloutArrays<T>& arrays) {
    return {
        &arrays.position,
        &arrays.orientation,
        &arrays.velocity,
        &arrays.angular_velocity,
        &arrays.node_position,
        &arrays.node_velocity,
        &arrays.force,
        &arrays.torque,
        &arrays.node_force,
        &arrays.body_velocity,
        &arrays.body_angular_velocity,
        &arrays.node_drive,
        &arrays.mass,
        &arrays.inertia,
        &arrays.gravity,
        &arrays.cloth_density,
        &arrays.cloth_stretch,
        &arrays.cloth_shear,
        &arrays.cloth_bend,
        &arrays.cloth_damping};
}

template <typename T>
std::array<BatchedView<T>*, kOutputCount> members(TrajectoryArrays<T>& arrays) {
    return {&arrays.position,         &arrays.orientation,   &arrays.velocity,
            &arrays.angular_velocity, &arrays.node_position, &arrays.node_velocity};
}

/// The leading axes of the inputs, found in a first pass over their shapes.
struct Leading {
    py::ssize_t steps = 1;
    bool has_time = false;   ///< controls have a time axis
    bool has_batch = false;  ///< some input has a batch axis
    py::ssize_t batch = 1;
};

Leading find_leading(const InputArrays& arrays, const Fields& fields, int steps, bool controls_have_time) {
    Leading leading;
    leading.steps = steps;
    leading.has_time = controls_have_time;
    for (std::size_t k = 0; k < fields.size(); ++k) {
        if (!arrays[k]) {
            if (!fields[k].is_control && fields[k].core.axes[0] > 0)
                throw std::invalid_argument(std::string(fields[k].name) + " must be given");
            continue;
        }
        const Array& array = *arrays[k];
        check_core(fields[k].name, array, fields[k].core.begin(), fields[k].core.end());
        const bool has_time = fields[k].is_control && controls_have_time;
        const py::ssize_t extra = array.ndim() - fields[k].core.rank;
        if (extra < (has_time ? 1 : 0) || extra > (has_time ? 2 : 1))
            throw std::invalid_argument(
                std::string(fields[k].name) + " has too few or too many leading axes, shape " +
                shape_text(shape_of(array)));
        if (has_time && array.shape(0) != steps)
            throw std::invalid_argument(
                std::string(fields[k].name) + " must have " + std::to_string(steps) +
                " entries along its time axis, got " + std::to_string(array.shape(0)));
        if (extra == (has_time ? 2 : 1)) {
            const py::ssize_t batch = array.shape(has_time ? 1 : 0);
            if (leading.has_batch && batch != leading.batch)
                throw std::invalid_argument(
                    std::string(fields[k].name) + " must have batch size " + std::to_string(leading.batch) + ", got " +
                    std::to_string(batch));
            leading.has_batch = true;
            leading.batch = batch;
        }
    }
    return leading;
}

template <typename T>
BatchedView<T> view_of(T* data, const Field& field, py::ssize_t ndim, const Leading& leading) {
    const bool has_time = field.is_control && leading.has_time;
    const py::ssize_t extra = ndim - field.core.rank;
    const bool has_batch = extra == (has_time ? 2 : 1);
    const py::ssize_t size = field.core.size();
    return {data, has_time ? size * (has_batch ? leading.batch : 1) : 0, has_batch ? size : 0};
}

RolloutInputs views_of(const InputArrays& arrays, const Fields& fields, const Leading& leading) {
    RolloutInputs inputs;
    const auto slots = members(inputs);
    for (std::size_t k = 0; k < fields.size(); ++k)
        if (arrays[k]) *slots[k] = view_of(arrays[k]->data(), fields[k], arrays[k]->ndim(), leading);
    return inputs;
}

/// An output's core shape.
Core output_core(const Model& model, std::size_t k) {
    return {k < 4 ? model.body_count() : model.node_count(), k == 1 ? 4 : 3};
}

Shape trajectory_shape(const Leading& leading, bool keep_time, const Core& core) {
    Shape shape;
    if (keep_time) shape.push_back(leading.steps);
    if (leading.has_batch) shape.push_back(leading.batch);
    shape.insert(shape.end(), core.begin(), core.end());
    return shape;
}

template <typename T>
BatchedView<T> trajectory_view(T* data, const Leading& leading, bool keep_time, const Core& core) {
    const py::ssize_t size = core.size();
    return {data, keep_time ? leading.batch * size : 0, leading.has_batch ? size : 0};
}

/// Python's signals, looked for by the thread that called, while it holds no lock.
class Signals {
public:
    /// Do work(interrupt) without the lock. What a signal's handler raised, KeyboardInterrupt say, is thrown on.
    template <typename Work>
    void watch(const Work& work) {
        try {
            const py::gil_scoped_release unlocked;
            work(&m_interrupt);
        } catch (...) {
            if (m_raised) std::rethrow_exception(m_raised);
            throw;
        }
        if (m_raised) std::rethrow_exception(m_raised);
    }

private:
    bool raised() {
        if (m_raised) return true;
        const py::gil_scoped_acquire locked;
        if (PyErr_CheckSignals() != 0) m_raised = std::make_exception_ptr(py::error_already_set());
        return m_raised != nullptr;
    }

    std::exception_ptr m_raised;
    Interrupt m_interrupt{[this] { return raised(); }};
};

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
    Rollout result{py::tuple(kOutputCount), record ? std::make_shared<Tape>() : nullptr, {}, {}};
    TrajectoryArrays<double> trajectory;
    const auto slots = members(trajectory);
    for (std::size_t k = 0; k < kOutputCount; ++k) {
        result.trajectory[k] = py::none();
        if (k >= 4 && model->cloths.empty()) continue;
        const Core core = output_core(*model, k);
        Array out(trajectory_shape(leading, keep_time, core));
        *slots[k] = trajectory_view(out.mutable_data(), leading, keep_time, core);
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
    const auto upstream_slots = members(upstream_views);
    for (std::size_t k = 0; k < kOutputCount; ++k) {
        if (!upstream[k]) continue;
        const Core core = output_core(*tape->model, k);
        const Shape expected = trajectory_shape(leading, keep_time, core);
        if (shape_of(*upstream[k]) != expected)
            throw std::invalid_argument(
                "the gradient of output " + std::to_string(k) + " must have shape " + shape_text(expected) + ", got " +
                shape_text(shape_of(*upstream[k])));
        *upstream_slots[k] = trajectory_view(upstream[k]->data(), leading, keep_time, core);
    }

    RolloutArrays<double> gradient;
    const auto slots = members(gradient);
    py::tuple result(fields.size());
    for (std::size_t k = 0; k < fields.size(); ++k) {
        result[k] = py::none();
        if (!needs[k] || !inputs[k]) continue;
        Array out(shape_of(*inputs[k]));
        std::fill_n(out.mutable_data(), out.size(), 0.0);
        *slots[k] = view_of(out.mutable_data(), fields[k], out.ndim(), leading);
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

template <typename Matrix>
Array array_of(const Matrix& matrix) {
    Array out(Shape{matrix.rows(), matrix.cols()});
    Eigen::Map<Eigen::Matrix<double, Eigen::Dynamic, Eigen::Dynamic, Eigen::RowMajor>>(
        out.mutable_data(), matrix.rows(), matrix.cols()) = matrix;
    return out;
}

py::tuple bound_contact_systems(const std::shared_ptr<Tape>& tape, const InputArrays& inputs) {
    const Fields fields = input_fields(*tape->model);
    const Leading leading = find_leading(inputs, fields, tape->shape.steps, tape->shape.controls_have_time);
    if (leading.batch != 1 || tape->shape.batch != 1)
        throw std::invalid_argument("contact_systems: there must be one scene");
    const std::vector<LinearisedZone> zones = linearised_zones(*tape, views_of(inputs, fields, leading), 0);
    py::tuple result(zones.size());
    for (std::size_t k = 0; k < zones.size(); ++k) {
        const LinearisedZone& zone = zones[k];
        const py::array_t<std::int64_t> bodies = py::cast(zone.bodies), nodes = py::cast(zone.nodes);
        const Array stiffness(static_cast<py::ssize_t>(zone.stiffness.size()), zone.stiffness.data());
        result[k] = py::make_tuple(bodies, nodes, array_of(zone.inertia), array_of(zone.J), stiffness);
    }
    return result;
}

SceneState scene_state(
    const Model& model, const Array& position, const Array& orientation, const Array& node_position) {
    const py::ssize_t n = model.body_count(), nodes = model.node_count();
    if (shape_of(position) != Shape{n, 3} || shape_of(orientation) != Shape{n, 4} ||
        shape_of(node_position) != Shape{nodes, 3})
        throw std::invalid_argument(
            "position, orientation and node_position must have shapes (n_bodies, 3), (n_bodies, 4) and (n_nodes, 3)");
    SceneState state;
    state.bodies.resize(model.bodies.size());
    for (py::ssize_t i = 0; i < n; ++i) {
        for (int k = 0; k < 3; ++k) state.bodies[i].position[k] = position.at(i, k);
        for (int k = 0; k < 4; ++k) state.bodies[i].orientation[k] = orientation.at(i, k);
        state.bodies[i].orientation.normalize();
    }
    for (py::ssize_t i = 0; i < nodes; ++i)
        state.node_position.emplace_back(node_position.at(i, 0), node_position.at(i, 1), node_position.at(i, 2));
    state.node_velocity.assign(state.node_position.size(), Vec3::Zero());
    return state;
}

py::tuple bound_min_distance(
    const Model& model, const Array& position, const Array& orientation, const Array& node_position) {
    const NearestObjects nearest = nearest_objects(model, scene_state(model, position, orientation, node_position));
    return py::make_tuple(nearest.distance, nearest.a, nearest.b);
}

py::tuple bound_separate(
    const Model& model, const Options& options, const Array& position, const Array& orientation,
    const Array& node_position, const Array& mass, const Array& inertia, const Array& cloth_density,
    const Array& cloth_stretch, const Array& cloth_shear, const Array& cloth_bend, const Array& cloth_damping) {
    const py::ssize_t n = model.body_count(), nodes = model.node_count(), cloths = model.cloth_count();
    const SceneState state = scene_state(model, position, orientation, node_position);
    if (shape_of(mass) != Shape{n} || shape_of(inertia) != Shape{n, 3, 3})
        throw std::invalid_argument("mass and inertia must have shapes (n_bodies,) and (n_bodies, 3, 3)");
    for (const Array* array : {&cloth_density, &cloth_stretch, &cloth_shear, &cloth_bend, &cloth_damping})
        if (shape_of(*array) != Shape{cloths})
            throw std::invalid_argument("parameters of cloth must have shape (n_cloths,)");
    Parameters parameters;
    for (py::ssize_t i = 0; i < n; ++i) {
        parameters.mass.push_back(mass.at(i));
        parameters.inertia.emplace_back(Eigen::Map<const Mat3>(inertia.data(i, 0, 0)));
    }
    for (py::ssize_t i = 0; i < cloths; ++i)
        parameters.cloths.push_back(
            {cloth_density.at(i), cloth_stretch.at(i), cloth_shear.at(i), cloth_bend.at(i), cloth_damping.at(i)});
    const SceneState moved = separate_state(model, options, parameters, state);
    Array new_position(Shape{n, 3}), new_orientation(Shape{n, 4}), new_nodes(Shape{nodes, 3});
    double max_shift = 0.0;
    for (py::ssize_t i = 0; i < n; ++i) {
        max_shift = std::max(max_shift, (moved.bodies[i].position - state.bodies[i].position).norm());
        for (int k = 0; k < 3; ++k) new_position.mutable_at(i, k) = moved.bodies[i].position[k];
        for (int k = 0; k < 4; ++k) new_orientation.mutable_at(i, k) = moved.bodies[i].orientation[k];
    }
    for (py::ssize_t i = 0; i < nodes; ++i) {
        max_shift = std::max(max_shift, (moved.node_position[i] - state.node_position[i]).norm());
        for (int k = 0; k < 3; ++k) new_nodes.mutable_at(i, k) = moved.node_position[i][k];
    }
    return py::make_tuple(new_position, new_orientation, new_nodes, max_shift);
}

/// Why a step did not converge, or nothing.
const char* failure_text(ZoneStatus status) {
    switch (status) {
        case ZoneStatus::converged:
            return "";
        case ZoneStatus::too_many_iterations:
            return "max_iterations reached";
        case ZoneStatus::no_descent:
            return "no step lowers the energy";
        case ZoneStatus::spinning:
            return "a body spins too fast";
        case ZoneStatus::blocked:
            return "a driven body is blocked: something is squeezed";
        case ZoneStatus::bad_start:
            return "objects penetrate at the start";
        case ZoneStatus::overflow:
            return "a motion is too large for numbers to hold";
    }
    return "";
}

/// The same as one word.
const char* status_text(ZoneStatus status) {
    switch (status) {
        case ZoneStatus::converged:
            return "converged";
        case ZoneStatus::too_many_iterations:
            return "max_iterations";
        case ZoneStatus::no_descent:
            return "no_descent";
        case ZoneStatus::spinning:
            return "spinning";
        case ZoneStatus::blocked:
            return "blocked";
        case ZoneStatus::bad_start:
            return "penetrating";
        case ZoneStatus::overflow:
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

    py::class_<Tape, std::shared_ptr<Tape>>(module, "Tape", "What the backward of a rollout needs.")
        .def_property_readonly("nbytes", &Tape::bytes);

    py::class_<RolloutInfo>(module, "Info", "Statistics of a rollout; counts are those of its last step.")
        .def_readonly("converged", &RolloutInfo::converged)
        .def_readonly("failed_steps", &RolloutInfo::failed_steps)
        .def_readonly("fast_impacts", &RolloutInfo::fast_impacts)
        .def_property_readonly("failure", [](const RolloutInfo& info) { return failure_text(info.status); })
        .def_property_readonly("failures", &failures)
        .def_property_readonly("scenes_converged", &scenes_converged)
        .def_property_readonly("contacts", [](const RolloutInfo& info) { return info.last.contacts; })
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

    module.def(
        "contact_systems", &bound_contact_systems, py::arg("tape"), py::arg("inputs").noconvert(),
        "What adjoint modes dense and qr solve in the last step, one per zone: (bodies, nodes, inertia, jacobian, "
        "stiffness).");

    module.def(
        "separate", &bound_separate, py::arg("model"), py::arg("options"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("node_position").noconvert(), py::kw_only(),
        py::arg("mass").noconvert(), py::arg("inertia").noconvert(), py::arg("cloth_density").noconvert(),
        py::arg("cloth_stretch").noconvert(), py::arg("cloth_shear").noconvert(), py::arg("cloth_bend").noconvert(),
        py::arg("cloth_damping").noconvert(),
        "Move bodies and cloth apart to their rest distance: (position, orientation, node_position, largest shift "
        "[m]).");

    module.def(
        "min_distance", &bound_min_distance, py::arg("model"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("node_position").noconvert());
}

}  // namespace diffsim::bindings
