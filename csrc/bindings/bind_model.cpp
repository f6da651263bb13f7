#include <pybind11/stl.h>

#include <stdexcept>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"

namespace diffsim::bindings {
namespace {

using IntArray = py::array_t<std::int32_t, py::array::c_style>;

std::shared_ptr<Model> make_model(
    const std::vector<std::string>& names, const IntArray& kind, const Array& margin, const IntArray& vertex_count,
    const Array& vertices, const IntArray& face_count, const IntArray& faces, bool has_ground, double ground_height,
    double ground_margin, double thickness) {
    const py::ssize_t count = static_cast<py::ssize_t>(names.size());
    if (kind.size() != count || margin.size() != count || vertex_count.size() != count || face_count.size() != count)
        throw std::invalid_argument("Model: kind, margin, vertex_count and face_count must have one entry per name");
    if (!(thickness > 0.0)) throw std::invalid_argument("Model: thickness must be positive");
    auto model = std::make_shared<Model>();
    model->thickness = thickness;
    model->ground = {has_ground, ground_height, ground_margin};
    py::ssize_t first_vertex = 0, first_face = 0;
    for (py::ssize_t i = 0; i < count; ++i) {
        const py::ssize_t vertex_end = first_vertex + vertex_count.at(i), face_end = first_face + face_count.at(i);
        if (vertices.ndim() != 2 || vertices.shape(1) != 3 || vertex_end > vertices.shape(0))
            throw std::invalid_argument("Model: vertices must have shape (sum of vertex_count, 3)");
        if (faces.ndim() != 2 || faces.shape(1) != 3 || face_end > faces.shape(0))
            throw std::invalid_argument("Model: faces must have shape (sum of face_count, 3)");
        if (kind.at(i) < 0 || kind.at(i) > 2) throw std::invalid_argument("Model: kind must be 0, 1 or 2");
        std::vector<Vec3> points;
        for (py::ssize_t v = first_vertex; v < vertex_end; ++v)
            points.emplace_back(vertices.at(v, 0), vertices.at(v, 1), vertices.at(v, 2));
        std::vector<Eigen::Vector3i> triangles;
        for (py::ssize_t f = first_face; f < face_end; ++f)
            triangles.emplace_back(faces.at(f, 0), faces.at(f, 1), faces.at(f, 2));
        Body body;
        body.name = names[static_cast<std::size_t>(i)];
        body.kind = static_cast<BodyKind>(kind.at(i));
        body.margin = margin.at(i);
        body.mesh = build_collision_mesh(std::move(points), triangles);
        model->bodies.push_back(std::move(body));
        first_vertex = vertex_end;
        first_face = face_end;
    }
    return model;
}

AdjointMode parse_adjoint(const std::string& text) {
    if (text == "exact") return AdjointMode::exact;
    if (text == "qr") return AdjointMode::qr;
    if (text == "dense") return AdjointMode::dense;
    throw std::invalid_argument("adjoint must be 'exact', 'qr' or 'dense', got '" + text + "'");
}

const char* adjoint_text(AdjointMode mode) {
    return mode == AdjointMode::exact ? "exact" : mode == AdjointMode::qr ? "qr" : "dense";
}

}  // namespace

void bind_model(py::module_& module) {
    py::class_<Model, std::shared_ptr<Model>>(module, "Model", "Bodies, their collision meshes and the ground.")
        .def(
            py::init(&make_model), py::kw_only(), py::arg("names"), py::arg("kind").noconvert(),
            py::arg("margin").noconvert(), py::arg("vertex_count").noconvert(), py::arg("vertices").noconvert(),
            py::arg("face_count").noconvert(), py::arg("faces").noconvert(), py::arg("has_ground"),
            py::arg("ground_height"), py::arg("ground_margin"), py::arg("thickness"))
        .def_property_readonly("body_count", &Model::body_count);

    const Options defaults;
    py::class_<Options>(module, "Options", "How steps are taken.")
        .def(
            py::init(
                [](double dt, double compliance, const std::string& adjoint, double tolerance, int max_iterations) {
                    return Options{dt, compliance, parse_adjoint(adjoint), tolerance, max_iterations};
                }),
            py::kw_only(), py::arg("dt"), py::arg("compliance") = defaults.compliance,
            py::arg("adjoint") = adjoint_text(defaults.adjoint), py::arg("tolerance") = defaults.tolerance,
            py::arg("max_iterations") = defaults.max_iterations)
        .def_readwrite("dt", &Options::dt)
        .def_readwrite("compliance", &Options::compliance)
        .def_readwrite("tolerance", &Options::tolerance)
        .def_readwrite("max_iterations", &Options::max_iterations)
        .def_property(
            "adjoint", [](const Options& options) { return adjoint_text(options.adjoint); },
            [](Options& options, const std::string& text) { options.adjoint = parse_adjoint(text); });
}

}  // namespace diffsim::bindings
