#include <pybind11/stl.h>

#include <algorithm>
#include <optional>
#include <stdexcept>

#include "bindings/arrays.hpp"
#include "bindings/bindings.hpp"

namespace diffsim::bindings {
namespace {

using IntArray = py::array_t<std::int32_t, py::array::c_style>;

using MaskArray = py::array_t<std::uint8_t, py::array::c_style>;

/// The cloths of a scene as `diffsim.scene.PackedScene` describes them.
struct ClothArrays {
    const std::vector<std::string>& names;
    const Array &margin, &poisson;
    const IntArray &node_count, &triangle_count, &triangles;
    const Array &node_rest, &warp;
    const MaskArray& pinned;
};

std::vector<Cloth> make_cloths(const ClothArrays& arrays) {
    const py::ssize_t count = static_cast<py::ssize_t>(arrays.names.size());
    if (arrays.margin.size() != count || arrays.poisson.size() != count || arrays.node_count.size() != count ||
        arrays.triangle_count.size() != count)
        throw std::invalid_argument(
            "Model: cloth_margin, cloth_poisson, node_count and triangle_count must have one entry per cloth name");
    if (arrays.warp.ndim() != 2 || arrays.warp.shape(0) != count || arrays.warp.shape(1) != 3)
        throw std::invalid_argument("Model: warp must have shape (n_cloths, 3)");
    py::ssize_t node_sum = 0, triangle_sum = 0;
    for (py::ssize_t i = 0; i < count; ++i) {
        node_sum += arrays.node_count.at(i);
        triangle_sum += arrays.triangle_count.at(i);
    }
    const auto has_shape = [](const py::array& array, py::ssize_t rows) {
        return array.ndim() == 2 && array.shape(0) == rows && array.shape(1) == 3;
    };
    if (!has_shape(arrays.node_rest, node_sum) || arrays.pinned.ndim() != 1 || arrays.pinned.size() != node_sum)
        throw std::invalid_argument("Model: node_rest and pinned must have one row per node");
    if (!has_shape(arrays.triangles, triangle_sum))
        throw std::invalid_argument("Model: triangles must have shape (sum of triangle_count, 3)");
    std::vector<Cloth> cloths;
    py::ssize_t node = 0, triangle = 0;
    for (py::ssize_t i = 0; i < count; ++i) {
        const py::ssize_t first_node = node, node_end = node + arrays.node_count.at(i);
        const py::ssize_t triangle_end = triangle + arrays.triangle_count.at(i);
        std::vector<Vec3> rest;
        for (; node < node_end; ++node)
            rest.emplace_back(arrays.node_rest.at(node, 0), arrays.node_rest.at(node, 1), arrays.node_rest.at(node, 2));
        std::vector<Eigen::Vector3i> triangles;
        for (; triangle < triangle_end; ++triangle)
            triangles.emplace_back(
                arrays.triangles.at(triangle, 0), arrays.triangles.at(triangle, 1), arrays.triangles.at(triangle, 2));
        const Vec3 warp(arrays.warp.at(i, 0), arrays.warp.at(i, 1), arrays.warp.at(i, 2));
        const std::string& name = arrays.names[static_cast<std::size_t>(i)];
        try {
            cloths.push_back(build_cloth(std::move(rest), triangles, warp));
        } catch (const std::invalid_argument& error) {
            throw std::invalid_argument("cloth '" + name + "': " + error.what());
        }
        Cloth& cloth = cloths.back();
        cloth.name = name;
        cloth.margin = arrays.margin.at(i);
        cloth.poisson = arrays.poisson.at(i);
        cloth.first_node = static_cast<int>(first_node);
        for (py::ssize_t k = first_node; k < node_end; ++k)
            cloth.pinned[static_cast<std::size_t>(k - first_node)] = arrays.pinned.at(k) != 0;
    }
    return cloths;
}

std::shared_ptr<Model> make_model(
    const std::vector<std::string>& names, const IntArray& kind, const Array& margin, const IntArray& vertex_count,
    const Array& vertices, const IntArray& face_count, const IntArray& faces, bool has_ground, double ground_height,
    std::optional<double> ground_margin, const Array& thickness, const std::vector<std::string>& cloth_names,
    const Array& cloth_margin, const Array& cloth_poisson, const IntArray& node_count, const IntArray& triangle_count,
    const IntArray& triangles, const Array& node_rest, const Array& warp, const MaskArray& pinned) {
    const py::ssize_t count = static_cast<py::ssize_t>(names.size());
    if (kind.size() != count || margin.size() != count || vertex_count.size() != count || face_count.size() != count)
        throw std::invalid_argument("Model: kind, margin, vertex_count and face_count must have one entry per name");
    if (thickness.ndim() != 1 || thickness.size() != count + static_cast<py::ssize_t>(cloth_names.size()))
        throw std::invalid_argument("Model: thickness must have one entry per name and cloth name");
    auto model = std::make_shared<Model>();
    model->thickness = kInfinity;
    for (py::ssize_t i = 0; i < thickness.size(); ++i) {
        if (!(thickness.at(i) > 0.0)) throw std::invalid_argument("Model: thickness must be positive");
        model->object_thickness.push_back(thickness.at(i));
        model->thickness = std::min(model->thickness, thickness.at(i));
    }
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
        std::vector<Eigen::Vector3i> sides;
        for (py::ssize_t f = first_face; f < face_end; ++f)
            sides.emplace_back(faces.at(f, 0), faces.at(f, 1), faces.at(f, 2));
        Body body;
        body.name = names[static_cast<std::size_t>(i)];
        body.kind = static_cast<BodyKind>(kind.at(i));
        body.margin = margin.at(i);
        body.mesh = build_collision_mesh(std::move(points), sides);
        model->bodies.push_back(std::move(body));
        first_vertex = vertex_end;
        first_face = face_end;
    }
    model->cloths = make_cloths(
        {cloth_names, cloth_margin, cloth_poisson, node_count, triangle_count, triangles, node_rest, warp, pinned});
    return model;
}

py::tuple hinges(const Model& model) {
    py::ssize_t hinge_count = 0, coupling_count = 0;
    for (const Cloth& cloth : model.cloths) {
        hinge_count += static_cast<py::ssize_t>(cloth.hinges.size());
        coupling_count += static_cast<py::ssize_t>(cloth.couplings.size());
    }
    py::array_t<std::int64_t> nodes({hinge_count, py::ssize_t{4}}), pairs({coupling_count, py::ssize_t{2}});
    Array rest_angle(hinge_count), weight(hinge_count), pair_weight(coupling_count);
    py::ssize_t first_hinge = 0, coupling = 0;
    for (const Cloth& cloth : model.cloths) {
        py::ssize_t row = first_hinge;
        for (const ClothHinge& hinge : cloth.hinges) {
            for (int k = 0; k < 4; ++k) nodes.mutable_at(row, k) = cloth.first_node + hinge.nodes[k];
            rest_angle.mutable_at(row) = hinge.rest_angle;
            weight.mutable_at(row++) = hinge.weight;
        }
        for (const HingeCoupling& entry : cloth.couplings) {
            pairs.mutable_at(coupling, 0) = first_hinge + entry.a;
            pairs.mutable_at(coupling, 1) = first_hinge + entry.b;
            pair_weight.mutable_at(coupling++) = entry.weight;
        }
        first_hinge = row;
    }
    return py::make_tuple(nodes, rest_angle, weight, pairs, pair_weight);
}

AdjointMode parse_adjoint(const std::string& text) {
    if (text == "exact") return AdjointMode::exact;
    if (text == "qr") return AdjointMode::qr;
    if (text == "dense") return AdjointMode::dense;
    throw std::invalid_argument("adjoint must be 'exact', 'qr' or 'dense', got '" + text + "'");
}

bool parse_coupling(const std::string& text) {
    if (text != "monolithic" && text != "split")
        throw std::invalid_argument("coupling must be 'monolithic' or 'split', got '" + text + "'");
    return text == "split";
}

bool parse_zones(const std::string& text) {
    if (text != "local" && text != "global")
        throw std::invalid_argument("zones must be 'local' or 'global', got '" + text + "'");
    return text == "global";
}

Integrator parse_integrator(const std::string& text) {
    if (text == "implicit_euler") return Integrator::implicit_euler;
    if (text == "second_order") return Integrator::second_order;
    throw std::invalid_argument("integrator must be 'implicit_euler' or 'second_order', got '" + text + "'");
}

const char* integrator_text(Integrator integrator) {
    return integrator == Integrator::second_order ? "second_order" : "implicit_euler";
}

const char* zones_text(bool global) { return global ? "global" : "local"; }

const char* coupling_text(bool split) { return split ? "split" : "monolithic"; }

const char* adjoint_text(AdjointMode mode) {
    return mode == AdjointMode::exact ? "exact" : mode == AdjointMode::qr ? "qr" : "dense";
}

/// Of bodies, then of cloths.
std::vector<std::string> object_names(const Model& model) {
    std::vector<std::string> names;
    for (const Body& body : model.bodies) names.push_back(body.name);
    for (const Cloth& cloth : model.cloths) names.push_back(cloth.name);
    return names;
}

void bind_options(py::module_& module) {
    const Options defaults;
    py::class_<Options>(module, "Options", "How steps are taken.")
        .def(
            py::init([](double dt, double compliance, const std::string& adjoint, double tolerance, int max_iterations,
                        const std::string& coupling, const std::string& zones, std::optional<int> newton_iterations,
                        const std::string& integrator) {
                if (newton_iterations && !parse_coupling(coupling))
                    throw std::invalid_argument("newton_iterations needs coupling 'split'");
                Options options;
                options.dt = dt;
                options.compliance = compliance;
                options.adjoint = parse_adjoint(adjoint);
                options.tolerance = tolerance;
                options.max_iterations = max_iterations;
                options.split = parse_coupling(coupling);
                options.global_zone = parse_zones(zones);
                options.newton_iterations = newton_iterations;
                options.integrator = parse_integrator(integrator);
                return options;
            }),
            py::kw_only(), py::arg("dt"), py::arg("compliance") = defaults.compliance,
            py::arg("adjoint") = adjoint_text(defaults.adjoint), py::arg("tolerance") = defaults.tolerance,
            py::arg("max_iterations") = defaults.max_iterations, py::arg("coupling") = coupling_text(defaults.split),
            py::arg("zones") = zones_text(defaults.global_zone),
            py::arg("newton_iterations") = defaults.newton_iterations,
            py::arg("integrator") = integrator_text(defaults.integrator))
        .def_readwrite("dt", &Options::dt)
        .def_readwrite("compliance", &Options::compliance)
        .def_readwrite("tolerance", &Options::tolerance)
        .def_readwrite("max_iterations", &Options::max_iterations)
        .def_property(
            "adjoint", [](const Options& options) { return adjoint_text(options.adjoint); },
            [](Options& options, const std::string& text) { options.adjoint = parse_adjoint(text); })
        .def_property(
            "coupling", [](const Options& options) { return coupling_text(options.split); },
            [](Options& options, const std::string& text) { options.split = parse_coupling(text); })
        .def_property(
            "zones", [](const Options& options) { return zones_text(options.global_zone); },
            [](Options& options, const std::string& text) { options.global_zone = parse_zones(text); })
        .def_readonly("newton_iterations", &Options::newton_iterations)
        .def_property(
            "integrator", [](const Options& options) { return integrator_text(options.integrator); },
            [](Options& options, const std::string& text) { options.integrator = parse_integrator(text); });
}

}  // namespace

void bind_model(py::module_& module) {
    py::class_<Model, std::shared_ptr<Model>>(module, "Model", "Bodies, cloths, their collision meshes and the ground.")
        .def(
            py::init(&make_model), py::kw_only(), py::arg("names"), py::arg("kind").noconvert(),
            py::arg("margin").noconvert(), py::arg("vertex_count").noconvert(), py::arg("vertices").noconvert(),
            py::arg("face_count").noconvert(), py::arg("faces").noconvert(), py::arg("has_ground"),
            py::arg("ground_height"), py::arg("ground_margin"), py::arg("thickness").noconvert(),
            py::arg("cloth_names"), py::arg("cloth_margin").noconvert(), py::arg("cloth_poisson").noconvert(),
            py::arg("node_count").noconvert(), py::arg("triangle_count").noconvert(), py::arg("triangles").noconvert(),
            py::arg("node_rest").noconvert(), py::arg("warp").noconvert(), py::arg("pinned").noconvert())
        .def_property_readonly("names", &object_names)
        .def_property_readonly("body_count", &Model::body_count)
        .def_property_readonly("cloth_count", &Model::cloth_count)
        .def_property_readonly("node_count", &Model::node_count)
        .def(
            "hinges", &hinges,
            "Of all cloths: nodes, angles at rest and weights of the hinges, pairs of coupled hinges and their "
            "weights.");
    bind_options(module);
}

}  // namespace diffsim::bindings
