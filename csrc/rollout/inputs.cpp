#include "rollout/inputs.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <sstream>

#include "model/number_text.hpp"
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

/// Whose entry of an input it is, as in " of body 'cube' (index 0)".
std::string owner_text(const Model& model, Axis axis, int index) {
    const std::string with_index = "' (index " + std::to_string(index) + ")";
    switch (axis) {
        case Axis::bodies:
            return " of body '" + model.name(index) + with_index;
        case Axis::cloths:
            return " of cloth '" + model.cloths[index].name + with_index;
        case Axis::objects:
            return " of '" + (index == model.body_count() + model.cloth_count() ? "ground" : model.name(index)) +
                   with_index;
        case Axis::nodes: {
            std::size_t cloth = 0;
            while (index >= model.cloths[cloth].first_node + model.cloths[cloth].node_count()) ++cloth;
            return " of node " + std::to_string(index - model.cloths[cloth].first_node) + " of cloth '" +
                   model.cloths[cloth].name + with_index;
        }
        case Axis::none:
            break;
    }
    return "";
}

[[noreturn]] void refuse(const Model& model, const Input& input, int index, const std::string& problem) {
    throw std::invalid_argument(input.label + owner_text(model, input.axis, index) + " " + problem);
}

/// "1 0 0" or, of parameters, whose units are part of what is said, "2 kg".
std::string with_unit(const Input& input, const std::string& value) {
    const bool told = kind_of(input) == InputKind::parameter && *input.unit != '\0';
    return told ? value + " " + input.unit : value;
}

template <typename Matrix>
void require_finite(const Model& model, const Input& input, int index, const Matrix& value) {
    if (!value.allFinite())
        refuse(model, input, index, "must be finite, got " + with_unit(input, "(" + text_of(value) + ")"));
}

void require_in_range(const Model& model, const Input& input, int index, double value) {
    const bool may_be_zero = input.allowed == Allowed::not_negative, any = input.allowed == Allowed::any;
    if (std::isfinite(value) && (any || value > 0.0 || (may_be_zero && value == 0.0))) return;
    const std::string sign = any ? "" : may_be_zero ? "zero or positive and " : "positive and ";
    refuse(model, input, index, "must be " + sign + "finite, got " + with_unit(input, number_text(value)));
}

/// One row per node; zeros where nothing is given.
void read_nodes(
    const Model& model, const Input& input, const BatchedView<const double>& view, int time, int scene,
    std::vector<Vec3>& nodes) {
    nodes.assign(static_cast<std::size_t>(model.node_count()), Vec3::Zero());
    if (!view.present()) return;
    for (int i = 0; i < model.node_count(); ++i) {
        nodes[i] = row<3>(view.at(time, scene), i);
        require_finite(model, input, i, nodes[i]);
    }
}

}  // namespace

SceneState read_state(const Model& model, const RolloutInputs& in, int scene) {
    SceneState state;
    state.bodies.resize(model.bodies.size());
    const auto read_vectors = [&](std::size_t k, Vec3 BodyState::* member) {
        for (int i = 0; i < model.body_count(); ++i) {
            state.bodies[i].*member = row<3>(in[k].at(0, scene), i);
            require_finite(model, kInputs[k], i, state.bodies[i].*member);
        }
    };
    const auto read_quaternions = [&](std::size_t k, Vec4 BodyState::* member) {
        for (int i = 0; i < model.body_count(); ++i) {
            Vec4& q = state.bodies[i].*member;
            q = row<4>(in[k].at(0, scene), i);
            require_finite(model, kInputs[k], i, q);
            const double norm = q.norm();
            if (!(std::abs(norm - 1.0) <= kUnitTolerance))
                refuse(
                    model, kInputs[k], i,
                    "must be a unit quaternion (w, x, y, z), got norm " + std::to_string(norm) +
                        "; divide it by its norm");
            if (std::abs(norm - 1.0) > 4.0 * kEpsilon) q /= norm;  // bits of our own states stay
        }
    };
    for_each_input<InputKind::state>(
        read_vectors, read_quaternions, [&](std::size_t k, std::vector<Vec3> SceneState::* member) {
            if (!model.cloths.empty()) read_nodes(model, kInputs[k], in[k], 0, scene, state.*member);
        });
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
    parameters.cloths.resize(model.cloths.size());
    const auto is_read = [&](const Input& input, int i) {
        return input.axis != Axis::bodies || model.bodies[i].is_dynamic();
    };
    const auto read_vector = [&](std::size_t k, Vec3 Parameters::* member) {
        parameters.*member = row<3>(in[k].at(0, scene), 0);
        require_finite(model, kInputs[k], 0, parameters.*member);
    };
    const auto read_numbers = [&](std::size_t k, std::vector<double> Parameters::* member) {
        const double* values = in[k].at(0, scene);
        const int count = row_count(model, kInputs[k].axis);
        for (int i = 0; i < count; ++i)
            if (is_read(kInputs[k], i)) require_in_range(model, kInputs[k], i, values[i]);
        // Of objects left empty where there is none, so that nothing asks for it.
        const bool left_out = kInputs[k].axis == Axis::objects &&
                              std::all_of(values, values + count, [](double value) { return value == 0.0; });
        if (!left_out) (parameters.*member).assign(values, values + count);
    };
    const auto read_matrices = [&](std::size_t k, std::vector<Mat3> Parameters::* member) {
        for (int i = 0; i < row_count(model, kInputs[k].axis); ++i) {
            const Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>> given(in[k].at(0, scene) + 9 * i);
            const Mat3 symmetric = 0.5 * (given + given.transpose());
            if (is_read(kInputs[k], i) && (!symmetric.allFinite() || symmetric.llt().info() != Eigen::Success))
                refuse(
                    model, kInputs[k], i,
                    "must be positive definite, got " + with_unit(kInputs[k], "(" + text_of(given) + ")"));
            (parameters.*member).push_back(symmetric);
        }
    };
    const auto read_of_cloths = [&](std::size_t k, double ClothParameters::* member) {
        for (int i = 0; i < model.cloth_count(); ++i) {
            const double value = in[k].at(0, scene)[i];
            require_in_range(model, kInputs[k], i, value);
            parameters.cloths[i].*member = value;
        }
    };
    for_each_input<InputKind::parameter>(read_vector, read_numbers, read_matrices, read_of_cloths);
    return parameters;
}

namespace {

constexpr const char* kKindNames[] = {"dynamic", "static", "kinematic"};
constexpr const char* kPushMend = "only a body of kind='dynamic' can be pushed";
constexpr const char* kDriveMend =
    "only a body of kind='kinematic' can be driven; the velocity of any other is given to the state";

/// A value that nothing would read is a mistake; zeros are what is given for bodies and nodes that are not meant.
void refuse_unread(const Model& model, const Input& input, int body, const Vec3& value) {
    refuse(
        model, input, body,
        "must be zero, because the body is " + std::string(kKindNames[static_cast<int>(model.bodies[body].kind)]) +
            ", got (" + text_of(value) + "); " +
            (drives(std::get<Vec3 BodyControl::*>(input.place)) ? kDriveMend : kPushMend));
}

void refuse_drives_of_free_nodes(const Model& model, const Input& input, const std::vector<Vec3>& velocity) {
    for (const Cloth& cloth : model.cloths)
        for (int i = 0; i < cloth.node_count(); ++i) {
            const Vec3& value = velocity[cloth.first_node + i];
            if (!cloth.pinned[i] && !value.isZero(0.0))
                refuse(
                    model, input, cloth.first_node + i,
                    "must be zero, because the node is not pinned, got (" + text_of(value) +
                        "); pin it (add_cloth: pinned=), or give its velocity to the state");
        }
}

}  // namespace

void read_control(
    const Model& model, const RolloutInputs& in, int time, int scene, const SceneState& state, Workers& workers,
    SceneControl& control) {
    control.bodies.resize(model.bodies.size());
    const auto read_range = [&](std::size_t k, Vec3 BodyControl::* member, int begin, int end) {
        const Vec3 BodyState::* otherwise = velocity_driven_by(member);
        const BodyKind read_of = drives(member) ? BodyKind::kinematic : BodyKind::dynamic;
        for (int i = begin; i < end; ++i) {
            Vec3& value = control.bodies[i].*member;
            if (in[k].present()) {
                value = row<3>(in[k].at(time, scene), i);
                require_finite(model, kInputs[k], i, value);
                if (model.bodies[i].kind != read_of && !value.isZero(0.0)) refuse_unread(model, kInputs[k], i, value);
            } else if (otherwise != nullptr) {
                value = state.bodies[i].*otherwise;
            } else {
                value.setZero();
            }
        }
    };
    workers.for_each_range(model.body_count(), kBodiesARange, [&](int begin, int end, int) {
        for_each_input<InputKind::control>(
            [&](std::size_t k, Vec3 BodyControl::* member) { read_range(k, member, begin, end); },
            [](std::size_t, std::vector<Vec3> SceneControl::*) {});
    });
    if (model.cloths.empty()) return;
    for_each_input<InputKind::control>(
        [](std::size_t, Vec3 BodyControl::*) {},
        [&](std::size_t k, std::vector<Vec3> SceneControl::* member) {
            read_nodes(model, kInputs[k], in[k], time, scene, control.*member);
            if (drives(member) && in[k].present()) refuse_drives_of_free_nodes(model, kInputs[k], control.*member);
        });
}

}  // namespace diffsim
