#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <vector>

#include "rollout/rollout.hpp"

/// Checked passage between numpy arrays and the views of the core.
namespace diffsim::bindings {

namespace py = pybind11;

using Array = py::array_t<double, py::array::c_style>;
using OptionalArray = std::optional<Array>;

/// "(2, 3)"
inline std::string shape_text(const std::vector<py::ssize_t>& shape) {
    std::string text = "(";
    for (std::size_t k = 0; k < shape.size(); ++k) text += (k > 0 ? ", " : "") + std::to_string(shape[k]);
    return text + (shape.size() == 1 ? ",)" : ")");
}

inline std::vector<py::ssize_t> shape_of(const py::array& array) {
    return {array.shape(), array.shape() + array.ndim()};
}

/// Throws unless the array's trailing axes are those in [begin, end).
inline void check_core(const char* name, const Array& array, const py::ssize_t* begin, const py::ssize_t* end) {
    const py::ssize_t extra = array.ndim() - (end - begin);
    if (extra < 0 || !std::equal(begin, end, array.shape() + extra))
        throw std::invalid_argument(
            std::string(name) + " must have trailing shape " + shape_text({begin, end}) + ", got " +
            shape_text(shape_of(array)));
}

}  // namespace diffsim::bindings
