#include <pybind11/stl.h>

#include <algorithm>
#include <stdexcept>

#include "bindings/bindings.hpp"
#include "bindings/rollout_arrays.hpp"
#include "rollout/inputs.hpp"
#include "scene_queries.hpp"

namespace diffsim::bindings {
namespace {

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

/// Arrays of contacts, which pushed in the last step, one after the other.
class ContactArrays {
public:
    void add(const Model& model, int scene, const ContactReadout& contact) {
        m_scene.push_back(scene);
        m_distance.push_back(contact.distance);
        m_sine_sq.push_back(contact.sine_sq);
        m_force.push_back(contact.force);
        m_stiffness.push_back(contact.stiffness);
        m_sticking.push_back(contact.sticks ? 1 : 0);
        append(m_friction, contact.friction);
        append(m_normal, contact.normal);
        for (const ContactReadout::Side& side : contact.sides) {
            m_object.push_back(side.object == kGround ? model.body_count() + model.cloth_count() : side.object);
            m_slide_count.push_back(side.slide_count);
            m_mass_exponent.push_back(side.mass_exponent);
            m_nodes.insert(m_nodes.end(), side.nodes.begin(), side.nodes.end());
            append(m_point, side.point);
            append(m_edge, side.edge);
            append(m_weights, side.weights);
            for (int k = 0; k < 2; ++k) {
                append(m_slides, side.slides[k]);
                append(m_slide_weights, side.slide_weights[k]);
            }
        }
    }

    py::dict arrays() const {
        const auto k = static_cast<py::ssize_t>(m_scene.size());
        py::dict result;
        result["scene"] = shaped(m_scene, {k});
        result["objects"] = shaped(m_object, {k, 2});
        result["normal"] = shaped(m_normal, {k, 3});
        result["distance"] = shaped(m_distance, {k});
        result["sine_sq"] = shaped(m_sine_sq, {k});
        result["force"] = shaped(m_force, {k});
        result["friction"] = shaped(m_friction, {k, 3});
        result["sticking"] = shaped(m_sticking, {k});
        result["stiffness"] = shaped(m_stiffness, {k});
        result["mass_exponent"] = shaped(m_mass_exponent, {k, 2});
        result["point"] = shaped(m_point, {k, 2, 3});
        result["edge"] = shaped(m_edge, {k, 2, 3});
        result["slide_count"] = shaped(m_slide_count, {k, 2});
        result["slides"] = shaped(m_slides, {k, 2, 2, 3});
        result["nodes"] = shaped(m_nodes, {k, 2, 3});
        result["weights"] = shaped(m_weights, {k, 2, 3});
        result["slide_weights"] = shaped(m_slide_weights, {k, 2, 2, 3});
        return result;
    }

private:
    static void append(std::vector<double>& values, const Vec3& v) {
        values.insert(values.end(), v.data(), v.data() + 3);
    }
    template <typename T>
    static py::array_t<T> shaped(const std::vector<T>& values, const Shape& shape) {
        return py::array_t<T>(shape, values.data());
    }

    std::vector<std::int64_t> m_scene, m_sticking, m_object, m_slide_count, m_nodes;
    std::vector<double> m_normal, m_distance, m_sine_sq, m_force, m_friction, m_stiffness, m_mass_exponent, m_point,
        m_edge, m_slides, m_weights, m_slide_weights;
};

py::dict bound_contacts(const std::shared_ptr<Tape>& tape, const InputArrays& inputs) {
    const Fields fields = input_fields(*tape->model);
    const Leading leading = find_leading(inputs, fields, tape->shape.steps, tape->shape.controls_have_time);
    if (leading.batch != tape->shape.batch)
        throw std::invalid_argument("contacts: inputs are not those of the forward");
    const RolloutInputs views = views_of(inputs, fields, leading);
    ContactArrays result;
    for (int scene = 0; scene < tape->shape.batch; ++scene)
        for (const ContactReadout& contact : last_contacts(*tape, views, scene))
            result.add(*tape->model, scene, contact);
    return result.arrays();
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

constexpr std::size_t kParameterCount = count_of(InputKind::parameter);

py::tuple bound_separate(
    const Model& model, const Options& options, const Array& position, const Array& orientation,
    const Array& node_position, const std::array<Array, kParameterCount>& parameters) {
    const py::ssize_t n = model.body_count(), nodes = model.node_count();
    const SceneState state = scene_state(model, position, orientation, node_position);
    RolloutInputs inputs;
    for (std::size_t i = 0; i < kParameterCount; ++i) {
        const std::size_t k = kInputCount - kParameterCount + i;
        const Core core = core_of(model, kInputs[k]);
        const Shape expected(core.begin(), core.end());
        if (shape_of(parameters[i]) != expected)
            throw std::invalid_argument(
                std::string(kInputs[k].label) + " must have shape " + shape_text(expected) + ", got " +
                shape_text(shape_of(parameters[i])));
        inputs[k].data = parameters[i].data();
    }
    const Parameters values = read_parameters(model, inputs, 0);
    const SceneState moved = separate_state(model, options, values, state);
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

}  // namespace

void bind_contacts(py::module_& module) {
    module.def(
        "contact_systems", &bound_contact_systems, py::arg("tape"), py::arg("inputs").noconvert(),
        "What adjoint modes dense and qr solve in the last step, one per zone: (bodies, nodes, inertia, jacobian, "
        "stiffness).");

    module.def(
        "contacts", &bound_contacts, py::arg("tape"), py::arg("inputs").noconvert(),
        "What pushed in the last step, of all scenes: arrays by name, see ContactReadout.");

    module.def(
        "separate", &bound_separate, py::arg("model"), py::arg("options"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("node_position").noconvert(), py::arg("parameters").noconvert(),
        "Move bodies and cloth apart to their rest distance: (position, orientation, node_position, largest shift "
        "[m]).");

    module.def(
        "min_distance", &bound_min_distance, py::arg("model"), py::arg("position").noconvert(),
        py::arg("orientation").noconvert(), py::arg("node_position").noconvert());
}

}  // namespace diffsim::bindings
