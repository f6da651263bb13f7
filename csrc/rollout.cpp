#include "rollout.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <chrono>
#include <cmath>
#include <sstream>
#include <stdexcept>

#include "math/rotation.hpp"
#include "scene_queries.hpp"

namespace diffsim {
namespace {

constexpr double kUnitTolerance = 1e-3;  // on |q|: single precision states pass, mistakes do not

template <int Rows>
Eigen::Map<const Eigen::Matrix<double, Rows, 1>> row(const double* data, int index) {
    return Eigen::Map<const Eigen::Matrix<double, Rows, 1>>(data + Rows * index);
}

template <int Rows>
Eigen::Map<Eigen::Matrix<double, Rows, 1>> row(double* data, int index) {
    return Eigen::Map<Eigen::Matrix<double, Rows, 1>>(data + Rows * index);
}

/// From how many bodies and nodes on threads are better used inside a scene than left idle for want of scenes.
constexpr int kBigScene = 256;

/// Call work(scene, workspace) for every scene. Threads divide the scenes among themselves where there is one for each of
/// them, else, where scenes are big, the bodies and zones of one scene after the other. The first exception, by scene, is
/// thrown on.
template <typename Work>
void for_each_scene(const Model& model, int batch, int thread_count, const Work& work) {
    const bool one_by_one =
        batch < thread_count && (batch == 1 || model.body_count() + model.node_count() >= kBigScene);
    const int scene_threads = one_by_one ? 1 : std::min(batch, thread_count);
    // Each thread makes its own and gives it back; see StepWorkspace::memory.
    std::vector<std::unique_ptr<StepWorkspace>> workspaces(static_cast<std::size_t>(scene_threads));
    Workers workers(scene_threads, [&](int thread) { workspaces[thread].reset(); });
    workers.for_each_range(batch, 1, [&](int begin, int end, int thread) {
        std::unique_ptr<StepWorkspace>& workspace = workspaces[thread];
        if (!workspace) workspace = std::make_unique<StepWorkspace>(one_by_one ? thread_count : 1);
        for (int scene = begin; scene < end; ++scene) work(scene, *workspace);
    });
}

// --- inputs --------------------------------------------------------------------------------------------------------

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

/// Do work; what it refuses is refused with, say, "in step 3" at the end of the message if there are several.
template <typename Work>
void located(bool several, const char* name, int index, const Work& work) {
    try {
        work();
    } catch (const std::invalid_argument& error) {
        if (!several) throw;
        throw std::invalid_argument(error.what() + std::string(", in ") + name + " " + std::to_string(index));
    }
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

/// Steps keep what is apart apart; what crosses to begin with they would keep crossed.
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

void write_state(const SceneState& state, const TrajectoryArrays<double>& out, int time, int scene, Workers& workers) {
    workers.for_each_range(static_cast<int>(state.bodies.size()), kBodiesARange, [&](int begin, int end, int) {
        for (int i = begin; i < end; ++i) {
            row<3>(out.position.at(time, scene), i) = state.bodies[i].position;
            row<4>(out.orientation.at(time, scene), i) = state.bodies[i].orientation;
            row<3>(out.velocity.at(time, scene), i) = state.bodies[i].velocity;
            row<3>(out.angular_velocity.at(time, scene), i) = state.bodies[i].angular_velocity;
        }
    });
    for (int i = 0; i < static_cast<int>(state.node_position.size()); ++i) {
        row<3>(out.node_position.at(time, scene), i) = state.node_position[i];
        row<3>(out.node_velocity.at(time, scene), i) = state.node_velocity[i];
    }
}

void merge_info(StepInfo& total, const StepInfo& scene) {
    total.converged = total.converged && scene.converged;
    total.contacts += scene.contacts;
    total.zones += scene.zones;
    total.largest_zone = std::max(total.largest_zone, scene.largest_zone);
    total.iterations = std::max(total.iterations, scene.iterations);
    total.residual = std::max(total.residual, scene.residual);
    total.max_compression = std::max(total.max_compression, scene.max_compression);
    total.seconds_motion += scene.seconds_motion;
    total.seconds_broad_phase += scene.seconds_broad_phase;
    total.seconds_zones += scene.seconds_zones;
}

// --- gradients -----------------------------------------------------------------------------------------------------

/// Gradients of one scene, in the order of the inputs, controls for one step or for all.
struct SceneGradient {
    SceneStateGradient state;
    std::vector<SceneControlGradient> control;  // per step; empty unless asked for
    ParameterGradient parameters;
};

void add_upstream(
    const TrajectoryArrays<const double>& upstream, int time, int scene, const SceneState& state, Workers& workers,
    SceneStateGradient& gradient) {
    workers.for_each_range(static_cast<int>(gradient.bodies.size()), kBodiesARange, [&](int begin, int end, int) {
        for (int i = begin; i < end; ++i) {
            BodyStateGradient& g = gradient.bodies[i];
            if (upstream.position.present()) g.position += row<3>(upstream.position.at(time, scene), i);
            if (upstream.velocity.present()) g.velocity += row<3>(upstream.velocity.at(time, scene), i);
            if (upstream.angular_velocity.present())
                g.angular_velocity += row<3>(upstream.angular_velocity.at(time, scene), i);
            if (upstream.orientation.present())
                g.orientation += quaternion_gradient_to_covector(
                    state.bodies[i].orientation, row<4>(upstream.orientation.at(time, scene), i));
        }
    });
    for (int i = 0; i < static_cast<int>(gradient.node_position.size()); ++i) {
        if (upstream.node_position.present())
            gradient.node_position[i] += row<3>(upstream.node_position.at(time, scene), i);
        if (upstream.node_velocity.present())
            gradient.node_velocity[i] += row<3>(upstream.node_velocity.at(time, scene), i);
    }
}

/// State at the end of a recorded step, by the same arithmetic again: of orientations alone.
SceneState end_state(const StepRecord& record) {
    SceneState end = record.start;
    if (record.held) return end;
    for (std::size_t i = 0; i < end.bodies.size(); ++i) {
        const Vec3 turn = record.y.bodies[i].head<3>();
        if (turn.isZero(0.0)) continue;
        end.bodies[i].orientation = quaternion_multiply(exp_quaternion(turn), end.bodies[i].orientation);
        end.bodies[i].orientation /= end.bodies[i].orientation.norm();
    }
    return end;
}

/// What the backward of a rollout's step has to compute: earlier steps need the state's gradient whether asked for or not.
GradientNeeds step_needs(const RolloutArrays<double>& wanted, int time) {
    const auto any = [](const auto&... views) { return (views.present() || ...); };
    GradientNeeds needs;
    needs.place = time > 0 || any(wanted.position, wanted.orientation, wanted.velocity, wanted.angular_velocity,
                                  wanted.node_position, wanted.node_velocity, wanted.body_velocity,
                                  wanted.body_angular_velocity, wanted.node_drive);
    needs.mass = any(wanted.mass, wanted.cloth_density);
    needs.inertia = any(wanted.inertia);
    needs.material = any(wanted.cloth_stretch, wanted.cloth_shear, wanted.cloth_bend, wanted.cloth_damping);
    return needs;
}

SceneGradient scene_backward(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& wanted, int scene, bool keep_controls, StepWorkspace& workspace) {
    const Model& model = *tape.model;
    const std::size_t count = model.bodies.size(), node_count = static_cast<std::size_t>(model.node_count());
    const Parameters parameters = read_parameters(model, inputs, scene);
    SceneGradient gradient;
    gradient.state.bodies.resize(count);
    gradient.state.node_position.assign(node_count, Vec3::Zero());
    gradient.state.node_velocity.assign(node_count, Vec3::Zero());
    if (keep_controls) gradient.control.resize(static_cast<std::size_t>(tape.shape.steps));
    gradient.parameters.mass.assign(count, 0.0);
    gradient.parameters.inertia.assign(count, Mat3::Zero());
    gradient.parameters.cloths.assign(model.cloths.size(), ClothParameters{});
    SceneControl control;
    SceneControlGradient scratch;
    const std::vector<StepRecord>& records = tape.records[scene];
    const SceneState final_state = end_state(records.back());
    for (int time = tape.shape.steps - 1; time >= 0; --time) {
        const bool last = time == tape.shape.steps - 1;
        if (tape.shape.keep_time || last)
            add_upstream(
                upstream, tape.shape.keep_time ? time : 0, scene, last ? final_state : records[time + 1].start,
                workspace.workers, gradient.state);
        const StepRecord& record = records[time];
        read_control(model, inputs, time, scene, record.start, workspace.workers, control);
        SceneControlGradient& control_gradient = keep_controls ? gradient.control[time] : scratch;
        control_gradient.bodies.assign(count, BodyControl{});
        control_gradient.node_force.assign(node_count, Vec3::Zero());
        control_gradient.node_velocity.assign(node_count, Vec3::Zero());
        step_backward(
            model, tape.options, parameters, control, record, step_needs(wanted, time), workspace, gradient.state,
            control_gradient, gradient.parameters);
        // Where a kinematic body was not driven, its own velocity drove it.
        for (std::size_t i = 0; i < count; ++i) {
            if (model.bodies[i].kind != BodyKind::kinematic) continue;
            if (!inputs.body_velocity.present())
                gradient.state.bodies[i].velocity += control_gradient.bodies[i].velocity;
            if (!inputs.body_angular_velocity.present())
                gradient.state.bodies[i].angular_velocity += control_gradient.bodies[i].angular_velocity;
        }
    }
    return gradient;
}

void write_cloth_gradient(
    const Model& model, const RolloutArrays<double>& out, int scene, const SceneGradient& gradient) {
    const auto add3 = [](const BatchedView<double>& view, int time, int batch, int node, const Vec3& value) {
        if (view.present()) row<3>(view.at(time, batch), node) += value;
    };
    const auto add = [&](const BatchedView<double>& view, int cloth, double value) {
        if (view.present()) view.at(0, scene)[cloth] += value;
    };
    for (int k = 0; k < model.cloth_count(); ++k) {
        const ClothParameters& parameters = gradient.parameters.cloths[k];
        add(out.cloth_density, k, parameters.density);
        add(out.cloth_stretch, k, parameters.stretch);
        add(out.cloth_shear, k, parameters.shear);
        add(out.cloth_bend, k, parameters.bend);
        add(out.cloth_damping, k, parameters.damping);
        const Cloth& cloth = model.cloths[k];
        for (int local = 0; local < cloth.node_count(); ++local) {
            const int node = cloth.first_node + local;
            add3(out.node_position, 0, scene, node, gradient.state.node_position[node]);
            add3(out.node_velocity, 0, scene, node, gradient.state.node_velocity[node]);
            for (int time = 0; time < static_cast<int>(gradient.control.size()); ++time) {
                const SceneControlGradient& control = gradient.control[time];
                if (cloth.pinned[local])
                    add3(out.node_drive, time, scene, node, control.node_velocity[node]);
                else
                    add3(out.node_force, time, scene, node, control.node_force[node]);
            }
        }
    }
}

void write_gradient(
    const Tape& tape, const RolloutInputs& inputs, const RolloutArrays<double>& out, int scene,
    const SceneGradient& gradient) {
    const int count = tape.model->body_count();
    const auto add3 = [](const BatchedView<double>& view, int time, int batch, int body, const Vec3& value) {
        if (view.present()) row<3>(view.at(time, batch), body) += value;
    };
    for (int i = 0; i < count; ++i) {
        const BodyStateGradient& g = gradient.state.bodies[i];
        add3(out.position, 0, scene, i, g.position);
        add3(out.velocity, 0, scene, i, g.velocity);
        add3(out.angular_velocity, 0, scene, i, g.angular_velocity);
        if (out.orientation.present()) {
            const Vec4 given = row<4>(inputs.orientation.at(0, scene), i);
            row<4>(out.orientation.at(0, scene), i) += covector_to_quaternion_gradient(given, g.orientation);
        }
        if (out.mass.present()) out.mass.at(0, scene)[i] += gradient.parameters.mass[i];
        if (out.inertia.present()) Eigen::Map<Mat3>(out.inertia.at(0, scene) + 9 * i) += gradient.parameters.inertia[i];
        const bool kinematic = tape.model->bodies[i].kind == BodyKind::kinematic;
        for (int time = 0; time < static_cast<int>(gradient.control.size()); ++time) {
            const BodyControl& c = gradient.control[time].bodies[i];
            if (kinematic) {
                add3(out.body_velocity, time, scene, i, c.velocity);
                add3(out.body_angular_velocity, time, scene, i, c.angular_velocity);
            } else {
                add3(out.force, time, scene, i, c.force);
                add3(out.torque, time, scene, i, c.torque);
            }
        }
    }
    if (out.gravity.present()) row<3>(out.gravity.at(0, scene), 0) += gradient.parameters.gravity;
    write_cloth_gradient(*tape.model, out, scene, gradient);
}

}  // namespace

std::size_t Tape::bytes() const {
    std::size_t total = sizeof(*this);
    for (const auto& scene : records)
        for (const StepRecord& record : scene) total += record.bytes();
    return total;
}

RolloutInfo rollout(
    const std::shared_ptr<const Model>& model, const Options& options, const RolloutShape& shape,
    const RolloutInputs& inputs, const TrajectoryArrays<double>& trajectory, std::vector<std::uint64_t>& signatures,
    Tape* tape, int thread_count) {
    const auto begin = std::chrono::steady_clock::now();
    if (tape != nullptr) {
        tape->model = model;
        tape->options = options;
        tape->shape = shape;
        tape->records.resize(static_cast<std::size_t>(shape.batch));
        for (auto& records : tape->records) records.resize(static_cast<std::size_t>(shape.steps));
    }
    signatures.assign(static_cast<std::size_t>(shape.steps) * static_cast<std::size_t>(shape.batch), 0);
    std::vector<RolloutInfo> infos(static_cast<std::size_t>(shape.batch));
    const auto advance = [&](int scene, StepWorkspace& workspace) {
        SceneState state = read_state(*model, inputs, scene);
        refuse_crossing(*model, state);
        const Parameters parameters = read_parameters(*model, inputs, scene);
        SceneControl control;
        RolloutInfo& info = infos[scene];
        for (int time = 0; time < shape.steps; ++time) {
            located(shape.controls_have_time, "step", shape.first_step + time, [&] {
                read_control(*model, inputs, time, scene, state, workspace.workers, control);
            });
            StepRecord* record = tape != nullptr ? &tape->records[scene][time] : nullptr;
            try {
                state = step(*model, options, parameters, state, control, workspace, info.last, record);
            } catch (const PenetratingStart&) {
                if (shape.first_step + time == 0) throw;  // the caller's state, not ours
                state = hold(state, info.last, record);
            }
            info.fast_impacts += info.last.fast_impacts;
            if (!info.last.converged && info.failed_steps++ == 0) info.status = info.last.status;
            signatures
                [static_cast<std::size_t>(time) * static_cast<std::size_t>(shape.batch) +
                 static_cast<std::size_t>(scene)] = info.last.signature;
            if (shape.keep_time) write_state(state, trajectory, time, scene, workspace.workers);
        }
        if (!shape.keep_time) write_state(state, trajectory, 0, scene, workspace.workers);
    };
    for_each_scene(*model, shape.batch, thread_count, [&](int scene, StepWorkspace& workspace) {
        located(shape.batch > 1, "scene", scene, [&] { advance(scene, workspace); });
    });
    RolloutInfo total;
    for (const RolloutInfo& info : infos) {
        if (total.status == ZoneStatus::converged) total.status = info.status;
        total.failed_steps += info.failed_steps;
        total.fast_impacts += info.fast_impacts;
        merge_info(total.last, info.last);
    }
    total.converged = total.failed_steps == 0;
    total.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
    return total;
}

void rollout_backward(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& gradient, int thread_count) {
    std::vector<SceneGradient> scenes(static_cast<std::size_t>(tape.shape.batch));
    const bool keep_controls = gradient.force.present() || gradient.torque.present() || gradient.node_force.present() ||
                               gradient.body_velocity.present() || gradient.body_angular_velocity.present() ||
                               gradient.node_drive.present();
    for_each_scene(*tape.model, tape.shape.batch, thread_count, [&](int scene, StepWorkspace& workspace) {
        scenes[scene] = scene_backward(tape, inputs, upstream, gradient, scene, keep_controls, workspace);
    });
    // Inputs that scenes share get the sum over the scenes, in their order.
    for (int scene = 0; scene < tape.shape.batch; ++scene) write_gradient(tape, inputs, gradient, scene, scenes[scene]);
}

std::vector<LinearisedZone> linearised_zones(const Tape& tape, const RolloutInputs& inputs, int scene) {
    const Model& model = *tape.model;
    const StepRecord& record = tape.records[scene].back();
    Workers workers(1);
    SceneControl control;
    read_control(model, inputs, tape.shape.steps - 1, scene, record.start, workers, control);
    return linearised_zones(model, tape.options, read_parameters(model, inputs, scene), control, record);
}

}  // namespace diffsim
