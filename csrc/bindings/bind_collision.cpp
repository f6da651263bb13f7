#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "collision/ccd.hpp"

namespace diffsim::bindings {
namespace {

std::vector<Vec3> points(const char* name, const Array& array, py::ssize_t count) {
    if (array.ndim() != 2 || array.shape(1) != 3 || (count > 0 && array.shape(0) != count))
        throw std::invalid_argument(
            std::string(name) + " must have shape " + (count > 0 ? shape_text({count, 3}) : std::string("(k, 3)")) +
            ", got " + shape_text(shape_of(array)));
    std::vector<Vec3> result;
    for (py::ssize_t k = 0; k < array.shape(0); ++k)
        result.emplace_back(array.at(k, 0), array.at(k, 1), array.at(k, 2));
    return result;
}

CcdOptions ccd_options(double min_distance, double tolerance) {
    if (!(min_distance >= 0.0) || !(tolerance > 0.0))
        throw std::invalid_argument("min_distance must not be negative and tolerance must be positive");
    CcdOptions options;
    options.min_distance = min_distance;
    options.tolerance = tolerance;
    return options;
}

double bound_vertex_polygon(
    const Array& vertex, const Array& polygon0, const Array& polygon1, double min_distance, double tolerance) {
    const std::vector<Vec3> x = points("vertex", vertex, 2);
    const std::vector<Vec3> p0 = points("polygon0", polygon0, 0);
    const std::vector<Vec3> p1 = points("polygon1", polygon1, static_cast<py::ssize_t>(p0.size()));
    return vertex_polygon_toi(
        x[0], x[1], p0.data(), p1.data(), static_cast<int>(p0.size()), ccd_options(min_distance, tolerance));
}

double bound_edge_edge(
    const Array& a0, const Array& a1, const Array& b0, const Array& b1, double min_distance, double tolerance) {
    return edge_edge_toi(
        points("a0", a0, 2).data(), points("a1", a1, 2).data(), points("b0", b0, 2).data(), points("b1", b1, 2).data(),
        ccd_options(min_distance, tolerance));
}

}  // namespace

void bind_collision(py::module_& module) {
    module.def(
        "vertex_polygon_toi", &bound_vertex_polygon, py::arg("vertex").noconvert(), py::arg("polygon0").noconvert(),
        py::arg("polygon1").noconvert(), py::arg("min_distance"), py::arg("tolerance"),
        "Conservative time of impact in [0, 1] of a vertex (rows: start, end) and a convex polygon, or inf.");
    module.def(
        "edge_edge_toi", &bound_edge_edge, py::arg("a0").noconvert(), py::arg("a1").noconvert(),
        py::arg("b0").noconvert(), py::arg("b1").noconvert(), py::arg("min_distance"), py::arg("tolerance"),
        "Conservative time of impact in [0, 1] of two edges (rows: ends; 0 and 1: start and end), or inf.");
}

}  // namespace diffsim::bindings
