#include "rollout/inputs.hpp"

#include <Eigen/Cholesky>
#include <cmath>
#include <sstream>

#include "scene_queries.hpp"

namespace diffsim {
namespace {

constexpr double kUnitTolerance = 1e-3;  // on |q|: single precision states pass, mistakes do not

/// Numbers as in 1 0 0, the rows of a matrix as in 1 0; 0 1.
template <typename Matrix>
std::string text_of(const Matrix& value) {
    static const Eigen::IOFormat format(6, Eigen::DontAlignCols, " ", "; ");
    std::ostringstream text;
    if constexpr (Matrix::ColsAtCompileTime == 1)
        text << value.transpose().format(format);
    else
        text << value.format(format);
    return text.str();
}

[[noreturn]] void refuse(const std::string& field, const Model& model, int body, const std::string& problem) {
    throw std::invalid_argument(
        field + " of body '" + model.name(body) + "' (index " + std::to_string(body) + ") " + problem);
}

template <typename Vector>
void require_finite(const char* field, const Model& model, int body, const Vector& value) {
    if (!value.allFinite()) refuse(field, model, body, "must be finite, got (" + text_of(value) + ")");
}

[[noreturn]] void refuse_node(
    const std::string& field, const Model& model, int node, const std::string& problem, const Vec3& value,
    const std::string& mend = "") {
    std::size_t cloth = 0;
    while (node >= model.cloths[cloth].first_node + model.cloths[cloth].node_count()) ++cloth;
    throw std::invalid_argument(
        field + " of node " + std::to_string(node - model.cloths[cloth].first_node) + " of cloth '" +
        model.cloths[cloth].name + "' (index " + std::to_string(node) + ") " + problem + ", got (" + text_of(value) +
        ")" + mend);
}

/// One row per node; zeros where nothing is given.
void read_nodes(
    const char* field, const Model& model, const BatchedView<const double>& view, int time, int scene,
    std::vector<Vec3>& nodes) {
    nodes.assign(static_cast<std::size_t>(model.node_count()), Vec3::Zero());
    if (!view.present()) return;
    for (int i = 0; i < model.node_count(); ++i) {
        nodes[i] = row<3>(view.at(time, scene), i);
        if (!nodes[i].allFinite()) refuse_node(field, model, i, "must be finite", nodes[i]);
    }
}

double read_cloth_parameter(
    const char* field, const char* unit, bool may_be_zero, const Model& model, const BatchedView<const double>& view,
    int cloth, int scene) {
    const double value = view.at(0, scene)[cloth];
    if (std::isfinite(value) && (value > 0.0 || (may_be_zero && value == 0.0))) return value;
    std::ostringstream text;
    text << field << " of cloth '" << model.cloths[cloth].name << "' (index " << cloth << ") must be "
         << (may_be_zero ? "zero or positive" : "positive") << " and finite, got " << value << " " << unit;
    throw std::invalid_argument(text.str());
}

/// Left empty where there is none, so that nothing asks for it.
void read_friction(const Model& model, const RolloutInputs& in, int scene, Parameters& parameters) {
    const int count = model.object_count();
    if (count == 0) return;
    const double* values = in.friction.at(0, scene);
    bool any = false;
    for (int i = 0; i < count; ++i) {
        if (!(values[i] >= 0.0) || !std::isfinite(values[i])) {
            const bool is_ground = i == model.body_count() + model.cloth_count();
            std::ostringstream text;
            text << "friction of '" << (is_ground ? "ground" : model.name(i)) << "' (index " << i
                 << ") must be zero or positive and finite, got " << values[i];
            throw std::invalid_argument(text.str());
        }
        any = any || values[i] > 0.0;
    }
    if (any) parameters.friction.assign(values, values + count);
}

}  // namespace

SceneState read_state(const Model& model, const RolloutInputs& in, int scene) {
    SceneState state;
    state.bodies.resize(model.bodies.size());
    for (int i = 0; i < model.body_count(); ++i) {
        BodyState& body = state.bodies[i];
        body.position = row<3>(in.position.at(0, scene), i);
        body.orientation = row<4>(in.orientation.at(0, scene), i);
        body.velocity = row<3>(in.velocity.at(0, scene), i);
        body.angular_velocity = row<3>(in.angular_velocity.at(0, scene), i);
        require_finite("state.position", model, i, body.position);
        require_finite("state.orientation", model, i, body.orientation);
        require_finite("state.velocity", model, i, body.velocity);
        require_finite("state.angular_velocity", model, i, body.angular_velocity);
        const double norm = body.orientation.norm();
        if (!(std::abs(norm - 1.0) <= kUnitTolerance))
            refuse(
                "state.orientation", model, i,
                "must be a unit quaternion (w, x, y, z), got norm " + std::to_string(norm) + "; divide it by its norm");
        if (std::abs(norm - 1.0) > 4.0 * kEpsilon) body.orientation /= norm;  // bits of our own states stay
    }
    if (!model.cloths.empty()) {
        read_nodes("state.node_position", model, in.node_position, 0, scene, state.node_position);
        read_nodes("state.node_velocity", model, in.node_velocity, 0, scene, state.node_velocity);
    }
    return state;
}

void refuse_crossing(const Model& model, const SceneState& state) {
    if (model.body_count() < 2 && model.cloths.empty()) return;
    const CrossingObjects crossing = find_crossing(model, state);
    if (crossing.a == kNobody) return;
    if (crossing.a == crossing.b)
        throw std::invalid_argument(
            "state: the mesh of '" + model.name(crossing.a) +
            "' crosses itself; start from a state in which it does not");
    throw std::invalid_argument(
        "state: the meshes of '" + model.name(crossing.a) + "' and '" + model.name(crossing.b) +
        "' cross; start from a state in which they are apart");
}

Parameters read_parameters(const Model& model, const RolloutInputs& in, int scene) {
    Parameters parameters;
    parameters.gravity = row<3>(in.gravity.at(0, scene), 0);
    if (!parameters.gravity.allFinite())
        throw std::invalid_argument("gravity must be finite, got (" + text_of(parameters.gravity) + ") m/s²");
    parameters.mass.resize(model.bodies.size());
    parameters.inertia.resize(model.bodies.size());
    for (int i = 0; i < model.body_count(); ++i) {
        const double* inertia = in.inertia.at(0, scene) + 9 * i;
        const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> given(inertia);
        parameters.mass[i] = in.mass.at(0, scene)[i];
        parameters.inertia[i] = 0.5 * (given + given.transpose());
        if (!model.bodies[i].is_dynamic()) continue;
        if (!(parameters.mass[i] > 0.0) || !std::isfinite(parameters.mass[i]))
            refuse("mass", model, i, "must be positive and finite, got " + std::to_string(parameters.mass[i]) + " kg");
        if (!parameters.inertia[i].allFinite() || parameters.inertia[i].llt().info() != Eigen::Success)
            refuse("inertia", model, i, "must be positive definite, got (" + text_of(given) + ") kg·m²");
    }
    read_friction(model, in, scene, parameters);
    for (int i = 0; i < model.cloth_count(); ++i) {
        ClothParameters cloth;
        cloth.density = read_cloth_parameter("cloth_density", "kg/m²", false, model, in.cloth_density, i, scene);
        cloth.stretch = read_cloth_parameter("cloth_stretch", "N/m", false, model, in.cloth_stretch, i, scene);
        cloth.shear = read_cloth_parameter("cloth_shear", "N/m", false, model, in.cloth_shear, i, scene);
        cloth.bend = read_cloth_parameter("cloth_bend", "N·m", false, model, in.cloth_bend, i, scene);
        cloth.damping = read_cloth_parameter("cloth_damping", "s", true, model, in.cloth_damping, i, scene);
        parameters.cloths.push_back(cloth);
    }
    return parameters;
}

constexpr const char* kKindNames[] = {"dynamic", "static", "kinematic"};
constexpr const char* kPushMend = "only a body of kind='dynamic' can be pushed";
constexpr const char* kDriveMend =
    "only a body of kind='kinematic' can be driven; the velocity of any other is given to the state";

void read_control(
    const Model& model, const RolloutInputs& in, int time, int scene, const SceneState& state, Workers& workers,
    SceneControl& control) {
    control.bodies.resize(model.bodies.size());
    // A value that nothing would read is a mistake; zeros are what is given for bodies that are not meant.
    const auto read = [&](const char* field, const BatchedView<const double>& view, int body, const Vec3& otherwise,
                          bool is_read, const char* mend) {
        if (!view.present()) return otherwise;
        const Vec3 value = row<3>(view.at(time, scene), body);
        require_finite(field, model, body, value);
        if (!is_read && !value.isZero(0.0))
            refuse(
                field, model, body,
                "must be zero, because the body is " +
                    std::string(kKindNames[static_cast<int>(model.bodies[body].kind)]) + ", got (" + text_of(value) +
                    "); " + mend);
        return value;
    };
    const Vec3 zero = Vec3::Zero();
    workers.for_each_range(model.body_count(), kBodiesARange, [&](int begin, int end, int) {
        for (int i = begin; i < end; ++i) {
            const bool pushed = model.bodies[i].is_dynamic(), driven = model.bodies[i].kind == BodyKind::kinematic;
            const BodyState& now = state.bodies[i];
            BodyControl& body = control.bodies[i];
            body.force = read("control.force", in.force, i, zero, pushed, kPushMend);
            body.torque = read("control.torque", in.torque, i, zero, pushed, kPushMend);
            body.velocity = read("control.body_velocity", in.body_velocity, i, now.velocity, driven, kDriveMend);
            body.angular_velocity = read(
                "control.body_angular_velocity", in.body_angular_velocity, i, now.angular_velocity, driven, kDriveMend);
        }
    });
    if (model.cloths.empty()) return;
    read_nodes("control.node_force", model, in.node_force, time, scene, control.node_force);
    read_nodes("control.node_velocity", model, in.node_drive, time, scene, control.node_velocity);
    if (!in.node_drive.present()) return;
    for (const Cloth& cloth : model.cloths)
        for (int i = 0; i < cloth.node_count(); ++i)
            if (!cloth.pinned[i] && !control.node_velocity[cloth.first_node + i].isZero(0.0))
                refuse_node(
                    "control.node_velocity", model, cloth.first_node + i,
                    "must be zero, because the node is not pinned", control.node_velocity[cloth.first_node + i],
                    "; pin it (add_cloth: pinned=), or give its velocity to the state");
}

}  // namespace diffsim
