#pragma once

#include <array>
#include <functional>
#include <numeric>
#include <optional>

#include "bindings/arrays.hpp"

/// The inputs and outputs of a rollout as numpy arrays: their names, shapes and leading axes.
namespace diffsim::bindings {

using Shape = std::vector<py::ssize_t>;

using InputArrays = std::array<OptionalArray, kInputCount>;   // in the order of the table
using OutputArrays = std::array<OptionalArray, kStateCount>;  // of the state's part of it

/// The axes of an array behind time and batch. Without a heap: a call makes some twenty of them.
struct Core {
    std::array<py::ssize_t, 3> axes{};
    py::ssize_t rank = 0;

    void add(py::ssize_t axis) { axes[static_cast<std::size_t>(rank++)] = axis; }
    const py::ssize_t* begin() const { return axes.data(); }
    const py::ssize_t* end() const { return axes.data() + rank; }
    py::ssize_t size() const { return std::accumulate(begin(), end(), py::ssize_t{1}, std::multiplies<py::ssize_t>()); }
};

inline Core core_of(const Model& model, const Input& input) {
    Core core;
    if (input.axis != Axis::none) core.add(row_count(model, input.axis));
    const RowShape row = row_shape(input);
    for (int axis = 0; axis < row.rank; ++axis) core.add(row.axes[static_cast<std::size_t>(axis)]);
    return core;
}

/// One input's name and core shape.
struct Field {
    const char* name;
    Core core;
    bool is_control;  ///< may have a time axis, and may be missing
};
using Fields = std::array<Field, kInputCount>;

inline Fields input_fields(const Model& model) {
    Fields fields;
    for (std::size_t k = 0; k < kInputCount; ++k)
        fields[k] = {kInputs[k].label, core_of(model, kInputs[k]), kind_of(kInputs[k]) == InputKind::control};
    return fields;
}

/// The leading axes of the inputs, found in a first pass over their shapes.
struct Leading {
    py::ssize_t steps = 1;
    bool has_time = false;   ///< controls have a time axis
    bool has_batch = false;  ///< some input has a batch axis
    py::ssize_t batch = 1;
};

inline Leading find_leading(const InputArrays& arrays, const Fields& fields, int steps, bool controls_have_time) {
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

inline RolloutInputs views_of(const InputArrays& arrays, const Fields& fields, const Leading& leading) {
    RolloutInputs inputs;
    for (std::size_t k = 0; k < fields.size(); ++k)
        if (arrays[k]) inputs[k] = view_of(arrays[k]->data(), fields[k], arrays[k]->ndim(), leading);
    return inputs;
}

inline Shape trajectory_shape(const Leading& leading, bool keep_time, const Core& core) {
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

}  // namespace diffsim::bindings
