#include <pybind11/stl.h>

#include <array>
#include <cstring>
#include <stdexcept>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "scene_queries.hpp"

namespace diffsim::bindings {
namespace {

using Shape = std::vector<py::ssize_t>;

/// One input's name, core shape and rank among the leading axes it may have.
struct Field {
    const char* name;
    Shape core;
    bool is_control;
};

std::array<Field, 11> input_fields(py::ssize_t n) {
    return {
        {{"position", {n, 3}, false},
         {"orientation", {n, 4}, false},
         {"velocity", {n, 3}, false},
         {"angular_velocity", {n, 3}, false},
         {"force", {n, 3}, true},
         {"torque", {n, 3}, true},
         {"body_velocity", {n, 3}, true},
         {"body_angular_velocity", {n, 3}, true},
         {"mass", {n}, false},
         {"inertia", {n, 3, 3}, false},
         {"gravity", {3}, false}}};
}

template <typename T>
std::array<BatchedView<T>*, 11> members(RolloutArrays<T>& arrays) {
    return {&arrays.position, &arrays.orientation, &arrays.velocity,      &arrays.angular_velocity,
            &arrays.force,    &arrays.torque,      &arrays.body_velocity, &arrays.body_angular_velocity,
            &arrays.mass,     &arrays.inertia,     &arrays.gravity};
}

py::ssize_t product(const Shape& shape) {
    py::ssize_t result = 1;
    for (py::ssize_t size : shape) result *= size;
    return result;
}

/// The leading axes of the inputs, found in a first pass over their shapes.
struct Leading {
    py::ssize_t steps = 1;
    bool has_time = false;   ///< controls have a time axis
    bool has_batch = false;  ///< some input has a batch axis
    py::ssize_t batch = 1;
};

Leading find_leading(
    const std::array<OptionalArray, 11>& arrays, const std::array<Field, 11>& fields, int steps,
    bool controls_have_time) {
    Leading leading;
    leading.steps = steps;
    leading.has_time = controls_have_time;
    for (std::size_t k = 0; k < fields.size(); ++k) {
        if (!arrays[k]) continue;
        const Array& array = *arrays[k];
        check_core(fields[k].name, array, fields[k].core);
        const bool has_time = fields[k].is_control && controls_have_time;
        const py::ssize_t extra = array.ndim() - static_cast<py::ssize_t>(fields[k].core.size());
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
    const py::ssize_t extra = ndim - static_cast<py::ssize_t>(field.core.size());
    const bool has_batch = extra == (has_time ? 2 : 1);
    const py::ssize_t size = product(field.core);
    return {data, has_time ? size * (has_batch ? leading.batch : 1) : 0, has_batch ? size : 0};
}

RolloutInputs views_of(
    const std::array<OptionalArray, 11>& arrays, const std::array<Field, 11>& fields, const Leading& leading) {
    RolloutInputs inputs;
    const auto slots = members(inputs);
    for (std::size_t k = 0; k < fields.size(); ++k)
        if (arrays[k]) *slots[k] = view_of(arrays[k]->data(), fields[k], arrays[k]->ndim(), leading);
    return inputs;
}

/// Shape of a trajectory array whose rows have `width` numbers.
Shape trajectory_shape(const Leading& leading, bool keep_time, py::ssize_t n, py::ssize_t width) {
    Shape shape;
    if (keep_time) shape.push_back(leading.steps);
    if (leading.has_batch) shape.push_back(leading.batch);
    shape.push_back(n);
    shape.push_back(width);
    return shape;
}

template <typename T>
BatchedView<T> trajectory_view(T* data, const Leading& leading, bool keep_time, py::ssize_t n, py::ssize_t width) {
    return {data, keep_time ? leading.batch * n * width : 0, leading.has_batch ? n * width : 0};
}

struct Rollout {
    Array position, orientation, velocity, angular_velocity;
    std::shared_ptr<Tape> tape;
    RolloutInfo info;
    py::array_t<std::uint64_t> signature;
};

Rollout bound_rollout(
    const std::shared_ptr<Model>& model, const Options& options, const Array& position, const Array& orientation,
    const Array& velocity, const Array& angular_velocity, const OptionalArray& force, const OptionalArray& torque,
    const OptionalArray& body_velocity, const OptionalArray& body_angular_velocity, const Array& mass,
    const Array& inertia, const Array& gravity, int steps, bool controls_have_time, bool keep_time, bool record,
    int num_threads) {
    if (steps < 1) throw std::invalid_argument("steps must be at least 1");
    const py::ssize_t n = model->body_count();
    const std::array<OptionalArray, 11> arrays = {position, orientation, velocity,      angular_velocity,
                                                  force,    torque,      body_velocity, body_angular_velocity,
                                                  mass,     inertia,     gravity};
    const std::array<Field, 11> fields = input_fields(n);
    const Leading leading = find_leading(arrays, fields, steps, controls_have_time);
    const RolloutInputs inputs = views_of(arrays, fields, leading);
    Rollout result{
        Array(trajectory_shape(leading, keep_time, n, 3)),
        Array(trajectory_shape(leading, keep_time, n, 4)),
        Array(trajectory_shape(leading, keep_time, n, 3)),
        Array(trajectory_shape(leading, keep_time, n, 3)),
        record ? std::make_shared<Tape>() : nullptr,
        {},
        {}};
    const TrajectoryArrays<double> trajectory{
        trajectory_view(result.position.mutable_data(), leading, keep_time, n, 3),
        trajectory_view(result.orientation.mutable_data(), leading, keep_time, n, 4),
        trajectory_view(result.velocity.mutable_data(), leading, keep_time, n, 3),
        trajectory_view(result.angular_velocity.mutable_data(), leading, keep_time, n, 3)};
    const RolloutShape shape{steps, static_cast<int>(leading.batch), keep_time, controls_have_time};
    std::vector<std::uint64_t> signatures;
    {
        py::gil_scoped_release unlocked;
        result.info = rollout(model, options, shape, inputs, trajectory, signatures, result.tape.get(), num_threads);
    }
    Shape signature_shape = {leading.steps};
    if (leading.has_batch) signature_shape.push_back(leading.batch);
    result.signature = py::array_t<std::uint64_t>(signature_shape);
    std::memcpy(result.signature.mutable_data(), signatures.data(), signatures.size() * sizeof(std::uint64_t));
    return result;
}

py::tuple bound_backward(
    const std::shared_ptr<Tape>& tape, const Array& position, const Array& orientation, const Array& velocity,
    const Array& angular_velocity, const OptionalArray& force, const OptionalArray& torque,
    const OptionalArray& body_velocity, const OptionalArray& body_angular_velocity, const Array& mass,
    const Array& inertia, const Array& gravity, const OptionalArray& grad_position,
    const OptionalArray& grad_orientation, const OptionalArray& grad_velocity,
    const OptionalArray& grad_angular_velocity, const std::array<bool, 11>& needs, int num_threads) {
    const py::ssize_t n = tape->model->body_count();
    const std::array<OptionalArray, 11> arrays = {position, orientation, velocity,      angular_velocity,
                                                  force,    torque,      body_velocity, body_angular_velocity,
                                                  mass,     inertia,     gravity};
    const std::array<Field, 11> fields = input_fields(n);
    const Leading leading = find_leading(arrays, fields, tape->shape.steps, tape->shape.controls_have_time);
    if (leading.batch != tape->shape.batch)
        throw std::invalid_argument("rollout_backward: inputs are not those of the forward");
    const RolloutInputs inputs = views_of(arrays, fields, leading);
    const bool keep_time = tape->shape.keep_time;

    TrajectoryArrays<const double> upstream;
    const auto read_upstream = [&](const char* name, const OptionalArray& array, py::ssize_t width,
                                   BatchedView<const double>& view) {
        if (!array) return;
        const Shape expected = trajectory_shape(leading, keep_time, n, width);
        if (shape_of(*array) != expected)
            throw std::invalid_argument(
                std::string(name) + " must have shape " + shape_text(expected) + ", got " +
                shape_text(shape_of(*array)));
        view = trajectory_view(array->data(), leading, keep_time, n, width);
    };
    read_upstream("grad_position", grad_position, 3, upstream.position);
    read_upstream("grad_orientation", grad_orientation, 4, upstream.orientation);
    read_upstream("grad_velocity", grad_velocity, 3, upstream.velocity);
    read_upstream("grad_angular_velocity", grad_angular_velocity, 3, upstream.angular_velocity);

    RolloutArrays<double> gradient;
    const auto slots = members(gradient);
    py::tuple result(fields.size());
    for (std::size_t k = 0; k < fields.size(); ++k) {
        result[k] = py::none();
        if (!needs[k] || !arrays[k]) continue;
        Array out(shape_of(*arrays[k]));
        std::fill_n(out.mutable_data(), out.size(), 0.0);
        *slots[k] = view_of(out.mutable_data(), fields[k], out.ndim(), leading);
        result[k] = std::move(out);
    }
    {
        py::gil_scoped_release unlocked;
        rollout_backward(*tape, inputs, upstream, gradient, num_threads);
    }
    return result;
}

SceneState scene_state(const Model& model, const Array& position, const Array& orientation) {
    const py::ssize_t n = model.body_count();
    if (shape_of(position) != Shape{n, 3} || shape_of(orientation) != Shape{n, 4})
        throw std::invalid_argument("position and orientation must have shapes (n_bodies, 3) and (n_bodies, 4)");
    SceneState state;
    state.bodies.resize(model.bodies.size());
    for (py::ssize_t i = 0; i < n; ++i) {
        for (int k = 0; k < 3; ++k) state.bodies[i].position[k] = position.at(i, k);
        for (int k = 0; k < 4; ++k) state.bodies[i].orientation[k] = orientation.at(i, k);
        state.bodies[i].orientation.normalize();
    }
    return state;
}

py::tuple bound_min_distance(const Model& model, const Array& position, const Array& orientation) {
    const NearestObjects nearest = nearest_objects(model, scene_state(model, position, orientation));
    return py::make_tuple(nearest.distance, nearest.a, nearest.b);
}

py::tuple bound_separate(
    const Model& model, const Options& options, const Array& position, const Array& orientation, const Array& mass,
    const Array& inertia) {
    const py::ssize_t n = model.body_count();
    const SceneState state = scene_state(model, position, orientation);
    if (shape_of(mass) != Shape{n} || shape_of(inertia) != Shape{n, 3, 3})
        throw std::invalid_argument("mass and inertia must have shapes (n_bodies,) and (n_bodies, 3, 3)");
    Parameters parameters;
    for (py::ssize_t i = 0; i < n; ++i) {
        parameters.mass.push_back(mass.at(i));
        parameters.inertia.emplace_back(Eigen::Map<const Mat3>(inertia.data(i, 0, 0)));
    }
    const SceneState moved = separate_state(model, options, parameters, state);
    Array new_position(Shape{n, 3}), new_orientation(Shape{n, 4});
    double max_shift = 0.0;
    for (py::ssize_t i = 0; i < n; ++i) {
        max_shift = std::max(max_shift, (moved.bodies[i].position - state.bodies[i].position).norm());
        for (int k = 0; k < 3; ++k) new_position.mutable_at(i, k) = moved.bodies[i].position[k];
        for (int k = 0; k < 4; ++k) new_orientation.mutable_at(i, k) = moved.bodies[i].orientation[k];
    }
    return py::make_tuple(new_position, new_orientation, max_shift);
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
        case ZoneStatus::blocked:
            return "a driven body is blocked: something is squeezed";
        case ZoneStatus::bad_start:
            return "objects penetrate at the start";
    }
    return "";
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
    py::class_<Tape, std::shared_ptr<Tape>>(module, "Tape", "What the backward of a rollout needs.")
        .def_property_readonly("nbytes", &Tape::bytes);

    py::class_<RolloutInfo>(module, "Info", "Statistics of a rollout; counts are those of its last step.")
        .def_readonly("converged", &RolloutInfo::converged)
        .def_readonly("failed_steps", &RolloutInfo::failed_steps)
        .def_property_readonly("failure", [](const RolloutInfo& info) { return failure_text(info.status); })
        .def_property_readonly("contacts", [](const RolloutInfo& info) { return info.last.contacts; })
        .def_property_readonly("zones", [](const RolloutInfo& info) { return info.last.zones; })
        .def_property_readonly("largest_zone", [](const RolloutInfo& info) { return info.last.largest_zone; })
        .def_property_readonly("iterations", [](const RolloutInfo& info) { return info.last.iterations; })
        .def_property_readonly("residual", [](const RolloutInfo& info) { return info.last.residual; })
        .def_property_readonly("max_compression", [](const RolloutInfo& info) { return info.last.max_compression; })
        .def_property_readonly("milliseconds", &milliseconds);

    py::class_<Rollout>(module, "Rollout", "Trajectory, tape and statistics.")
        .def_readonly("position", &Rollout::position)
        .def_readonly("orientation", &Rollout::orientation)
        .def_readonly("velocity", &Rollout::velocity)
        .def_readonly("angular_velocity", &Rollout::angular_velocity)
        .def_readonly("tape", &Rollout::tape)
        .def_readonly("info", &Rollout::info)
        .def_readonly("signature", &Rollout::signature);

    module.def(
        "rollout", &bound_rollout, py::arg("model"), py::arg("options"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("velocity").noconvert(), py::arg("angular_velocity").noconvert(),
        py::arg("force").noconvert().none(true), py::arg("torque").noconvert().none(true),
        py::arg("body_velocity").noconvert().none(true), py::arg("body_angular_velocity").noconvert().none(true),
        py::arg("mass").noconvert(), py::arg("inertia").noconvert(), py::arg("gravity").noconvert(), py::kw_only(),
        py::arg("steps"), py::arg("controls_have_time"), py::arg("keep_time"), py::arg("record"),
        py::arg("num_threads"));

    module.def(
        "rollout_backward", &bound_backward, py::arg("tape"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("velocity").noconvert(), py::arg("angular_velocity").noconvert(),
        py::arg("force").noconvert().none(true), py::arg("torque").noconvert().none(true),
        py::arg("body_velocity").noconvert().none(true), py::arg("body_angular_velocity").noconvert().none(true),
        py::arg("mass").noconvert(), py::arg("inertia").noconvert(), py::arg("gravity").noconvert(),
        py::arg("grad_position").noconvert().none(true), py::arg("grad_orientation").noconvert().none(true),
        py::arg("grad_velocity").noconvert().none(true), py::arg("grad_angular_velocity").noconvert().none(true),
        py::arg("needs"), py::arg("num_threads"));

    module.def(
        "separate", &bound_separate, py::arg("model"), py::arg("options"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("mass").noconvert(), py::arg("inertia").noconvert(),
        "Move dynamic bodies apart to their rest distance: (position, orientation, largest shift [m]).");

    module.def(
        "min_distance", &bound_min_distance, py::arg("model"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert());
}

}  // namespace diffsim::bindings
