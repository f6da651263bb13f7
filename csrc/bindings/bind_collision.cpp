#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"
#include "collision/ccd.hpp"

namespace diffsim::bindings {
namespace {

/// Of n queries, `corners` points each.
std::vector<Vec3> points(const char* name, const Array& array, py::ssize_t n, py::ssize_t corners) {
    const std::vector<py::ssize_t> shape = shape_of(array), expected = {n, corners, 3};
    if (shape != expected)
        throw std::invalid_argument(
            std::string(name) + " must have shape " + shape_text(expected) + ", got " + shape_text(shape));
    std::vector<Vec3> result;
    result.reserve(static_cast<std::size_t>(n * corners));
    for (const double* x = array.data(); x != array.data() + array.size(); x += 3)
        result.emplace_back(x[0], x[1], x[2]);
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

/// Times and iterations of n queries; `query(k)` answers one.
template <typename Query>
py::tuple answers(py::ssize_t n, const Query& query) {
    py::array_t<double> toi(n);
    py::array_t<std::int64_t> iterations(n);
    double* to_toi = toi.mutable_data();
    std::int64_t* to_iterations = iterations.mutable_data();
    {
        const py::gil_scoped_release release;
        for (py::ssize_t k = 0; k < n; ++k) {
            const CcdResult result = query(k);
            to_toi[k] = result.toi;
            to_iterations[k] = result.iterations;
        }
    }
    return py::make_tuple(toi, iterations);
}

py::tuple bound_vertex_polygon(
    const Array& vertex, const Array& polygon0, const Array& polygon1, double min_distance, double tolerance) {
    if (polygon0.ndim() != 3 || polygon0.shape(1) == 0)
        throw std::invalid_argument(
            "polygon0 must have shape (n, k, 3) with k > 0, got " + shape_text(shape_of(polygon0)));
    const py::ssize_t n = polygon0.shape(0), corners = polygon0.shape(1);
    const std::vector<Vec3> x = points("vertex", vertex, n, 2);
    const std::vector<Vec3> p0 = points("polygon0", polygon0, n, corners);
    const std::vector<Vec3> p1 = points("polygon1", polygon1, n, corners);
    const CcdOptions options = ccd_options(min_distance, tolerance);
    return answers(n, [&](py::ssize_t k) {
        const Vec3 *v = x.data() + 2 * k, *begin = p0.data() + corners * k, *end = p1.data() + corners * k;
        return vertex_polygon_ccd(v[0], v[1], begin, end, static_cast<int>(corners), options);
    });
}

py::tuple bound_edge_edge(
    const Array& a0, const Array& a1, const Array& b0, const Array& b1, double min_distance, double tolerance) {
    const py::ssize_t n = a0.ndim() > 0 ? a0.shape(0) : 0;
    const std::vector<Vec3> from_a = points("a0", a0, n, 2), to_a = points("a1", a1, n, 2);
    const std::vector<Vec3> from_b = points("b0", b0, n, 2), to_b = points("b1", b1, n, 2);
    const CcdOptions options = ccd_options(min_distance, tolerance);
    return answers(n, [&](py::ssize_t k) {
        return edge_edge_ccd(&from_a[2 * k], &to_a[2 * k], &from_b[2 * k], &to_b[2 * k], options);
    });
}

}  // namespace

void bind_collision(py::module_& module) {
    module.def(
        "vertex_polygon_ccd", &bound_vertex_polygon, py::arg("vertex").noconvert(), py::arg("polygon0").noconvert(),
        py::arg("polygon1").noconvert(), py::arg("min_distance"), py::arg("tolerance"),
        "Conservative times of impact in [0, 1] or inf, and iterations, of vertices (n, 2, 3) (start, end) and convex "
        "polygons (n, k, 3) (0 and 1: start and end).");
    module.def(
        "edge_edge_ccd", &bound_edge_edge, py::arg("a0").noconvert(), py::arg("a1").noconvert(),
        py::arg("b0").noconvert(), py::arg("b1").noconvert(), py::arg("min_distance"), py::arg("tolerance"),
        "Conservative times of impact in [0, 1] or inf, and iterations, of pairs of edges (n, 2, 3) (0 and 1: start "
        "and "
        "end).");
}

}  // namespace diffsim::bindings
