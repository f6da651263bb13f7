#include <algorithm>
#include <cmath>

#include "math/rotation.hpp"
#include "rollout/inputs.hpp"
#include "rollout/scenes.hpp"
#include "step/body_step.hpp"

namespace diffsim {
namespace {

/// Gradients of one scene, in the order of the inputs, controls for one step or for all.
struct SceneGradient {
    SceneStateGradient state;
    std::vector<SceneControlGradient> control;  // per step; empty unless asked for
    ParameterGradient parameters;
};

/// Where a body's part of the state's gradient is kept.
struct BodyStateSlot {
    std::size_t input;
    Vec3 BodyStateGradient::* gradient;
};
inline constexpr std::size_t kOrientation = input_index("state.orientation");  // a covector, see BodyStateGradient
inline constexpr BodyStateSlot kBodyStateSlots[] = {
    {input_index("state.position"), &BodyStateGradient::position},
    {kOrientation, &BodyStateGradient::orientation},
    {input_index("state.velocity"), &BodyStateGradient::velocity},
    {input_index("state.angular_velocity"), &BodyStateGradient::angular_velocity},
};
/// The same of nodes.
struct NodeStateSlot {
    std::size_t input;
    std::vector<Vec3> SceneStateGradient::* gradient;
};
inline constexpr NodeStateSlot kNodeStateSlots[] = {
    {input_index("state.node_position"), &SceneStateGradient::node_position},
    {input_index("state.node_velocity"), &SceneStateGradient::node_velocity},
};
static_assert(std::size(kBodyStateSlots) + std::size(kNodeStateSlots) == kStateCount);

void add_upstream(
    const TrajectoryArrays<const double>& upstream, int time, int scene, const SceneState& state, Workers& workers,
    SceneStateGradient& gradient) {
    workers.for_each_range(static_cast<int>(gradient.bodies.size()), kBodiesARange, [&](int begin, int end, int) {
        for (const BodyStateSlot& slot : kBodyStateSlots) {
            if (!upstream[slot.input].present()) continue;
            const double* const rows = upstream[slot.input].at(time, scene);
            for (int i = begin; i < end; ++i) {
                Vec3& g = gradient.bodies[i].*slot.gradient;
                if (slot.input == kOrientation)
                    g += quaternion_gradient_to_covector(state.bodies[i].orientation, row<4>(rows, i));
                else
                    g += row<3>(rows, i);
            }
        }
    });
    for (const NodeStateSlot& slot : kNodeStateSlots) {
        std::vector<Vec3>& g = gradient.*slot.gradient;
        for (int i = 0; upstream[slot.input].present() && i < static_cast<int>(g.size()); ++i)
            g[i] += row<3>(upstream[slot.input].at(time, scene), i);
    }
}

/// State at the end of a recorded step, by the same arithmetic again: of orientations alone.
SceneState end_state(const StepRecord& record) {
    SceneState end = record.start;
    if (record.held) return end;
    for (const StepRecord* part = &record; part != nullptr; part = part->next.get())
        for (std::size_t i = 0; i < end.bodies.size(); ++i)
            end.bodies[i].orientation = turned(end.bodies[i].orientation, part->y.bodies[i].head<3>());
    return end;
}

/// What the backward of a rollout's step has to compute: earlier steps need the state's
/// gradient whether asked for or not.
GradientNeeds step_needs(const RolloutArrays<double>& wanted, int time) {
    GradientNeeds needs{time > 0, false, false, false};
    for (std::size_t k = 0; k < kInputCount; ++k)
        if (wanted[k].present() && kInputs[k].need != nullptr) needs.*kInputs[k].need = true;
    return needs;
}

/// Of all parameters, zero.
ParameterGradient zero_gradient(const Parameters& parameters) {
    ParameterGradient zero;
    zero.cloths.resize(parameters.cloths.size());
    for_each_input<InputKind::parameter>(
        [&](std::size_t, Vec3 Parameters::* member) { (zero.*member).setZero(); },
        [&](std::size_t, std::vector<double> Parameters::* member) {
            (zero.*member).assign((parameters.*member).size(), 0.0);
        },
        [&](std::size_t, std::vector<Mat3> Parameters::* member) {
            (zero.*member).assign((parameters.*member).size(), Mat3::Zero());
        },
        [](std::size_t, double ClothParameters::*) {});
    return zero;
}

/// Where a kinematic body is not driven, its own velocity drives it.
void add_gradient_of_undriven(
    const Model& model, const RolloutInputs& inputs, const SceneControlGradient& control, SceneStateGradient& state) {
    constexpr std::size_t kVelocity = input_index("control.body_velocity");
    constexpr std::size_t kAngularVelocity = input_index("control.body_angular_velocity");
    for (std::size_t i = 0; i < model.bodies.size(); ++i) {
        if (model.bodies[i].kind != BodyKind::kinematic) continue;
        if (!inputs[kVelocity].present()) state.bodies[i].velocity += control.bodies[i].velocity;
        if (!inputs[kAngularVelocity].present()) state.bodies[i].angular_velocity += control.bodies[i].angular_velocity;
    }
}

/// Calls after_step(time, gradient so far, gradient of the step's control), which says whether to go on.
template <typename AfterStep>
SceneGradient scene_backward(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& wanted, int scene, bool keep_controls, StepWorkspace& workspace,
    const AfterStep& after_step) {
    const Model& model = *tape.model;
    const std::size_t count = model.bodies.size(), node_count = static_cast<std::size_t>(model.node_count());
    const Parameters parameters = read_parameters(model, inputs, scene);
    SceneGradient gradient;
    gradient.state.bodies.resize(count);
    gradient.state.node_position.assign(node_count, Vec3::Zero());
    gradient.state.node_velocity.assign(node_count, Vec3::Zero());
    if (keep_controls) gradient.control.resize(static_cast<std::size_t>(tape.shape.steps));
    gradient.parameters = zero_gradient(parameters);
    SceneControl control;
    SceneControlGradient scratch;
    const std::vector<StepRecord>& records = tape.records[scene];
    const SceneState final_state = end_state(records.back());
    for (int time = tape.shape.steps - 1; time >= 0; --time) {
        if (workspace.interrupt != nullptr) workspace.interrupt->throw_if_asked();
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
        add_gradient_of_undriven(model, inputs, control_gradient, gradient.state);
        if (!after_step(time, gradient, control_gradient)) break;
    }
    return gradient;
}

void write_state_gradient(
    const Model& model, const RolloutInputs& inputs, const RolloutArrays<double>& out, int scene,
    const SceneStateGradient& gradient) {
    for (const BodyStateSlot& slot : kBodyStateSlots) {
        if (!out[slot.input].present()) continue;
        double* const rows = out[slot.input].at(0, scene);
        for (int i = 0; i < model.body_count(); ++i) {
            const Vec3& g = gradient.bodies[i].*slot.gradient;
            if (slot.input == kOrientation) {
                const Vec4 given = row<4>(inputs[kOrientation].at(0, scene), i);
                row<4>(rows, i) += covector_to_quaternion_gradient(given, g);
            } else {
                row<3>(rows, i) += g;
            }
        }
    }
    for (const NodeStateSlot& slot : kNodeStateSlots)
        for (int i = 0; out[slot.input].present() && i < model.node_count(); ++i)
            row<3>(out[slot.input].at(0, scene), i) += (gradient.*slot.gradient)[i];
}

/// To what is pushed or to what is driven, whichever a control is read of.
void write_control_gradient(
    const Model& model, const RolloutArrays<double>& out, int time, int scene, const SceneControlGradient& gradient) {
    const auto write = [&](std::size_t k, Vec3 BodyControl::* member) {
        for (int i = 0; out[k].present() && i < model.body_count(); ++i)
            if (drives(member) == (model.bodies[i].kind == BodyKind::kinematic))
                row<3>(out[k].at(time, scene), i) += gradient.bodies[i].*member;
    };
    const auto write_nodes = [&](std::size_t k, std::vector<Vec3> SceneControl::* member) {
        if (!out[k].present()) return;
        for (const Cloth& cloth : model.cloths)
            for (int i = 0; i < cloth.node_count(); ++i)
                if (drives(member) == (cloth.pinned[i] != 0))
                    row<3>(out[k].at(time, scene), cloth.first_node + i) += (gradient.*member)[cloth.first_node + i];
    };
    for_each_input<InputKind::control>(write, write_nodes);
}

void write_parameter_gradient(const RolloutArrays<double>& out, int scene, const ParameterGradient& gradient) {
    const auto write_vector = [&](std::size_t k, Vec3 Parameters::* member) {
        if (out[k].present()) row<3>(out[k].at(0, scene), 0) += gradient.*member;
    };
    const auto write_numbers = [&](std::size_t k, std::vector<double> Parameters::* member) {
        for (std::size_t i = 0; out[k].present() && i < (gradient.*member).size(); ++i)
            out[k].at(0, scene)[i] += (gradient.*member)[i];
    };
    const auto write_matrices = [&](std::size_t k, std::vector<Mat3> Parameters::* member) {
        for (std::size_t i = 0; out[k].present() && i < (gradient.*member).size(); ++i)
            Eigen::Map<Mat3>(out[k].at(0, scene) + 9 * i) += (gradient.*member)[i];
    };
    const auto write_of_cloths = [&](std::size_t k, double ClothParameters::* member) {
        for (std::size_t i = 0; out[k].present() && i < gradient.cloths.size(); ++i)
            out[k].at(0, scene)[i] += gradient.cloths[i].*member;
    };
    for_each_input<InputKind::parameter>(write_vector, write_numbers, write_matrices, write_of_cloths);
}

void write_gradient(
    const Tape& tape, const RolloutInputs& inputs, const RolloutArrays<double>& out, int scene,
    const SceneGradient& gradient) {
    write_state_gradient(*tape.model, inputs, out, scene, gradient.state);
    for (int time = 0; time < static_cast<int>(gradient.control.size()); ++time)
        write_control_gradient(*tape.model, out, time, scene, gradient.control[time]);
    write_parameter_gradient(out, scene, gradient.parameters);
}

// --- gradients that are not finite ---------------------------------------------------------------------------------

/// What of a step's gradients is not finite, or too large.
class FaultCollector {
public:
    FaultCollector(const Model& model, double limit) : m_model(model), m_limit(limit) {}

    void add_state(const SceneStateGradient& gradient) {
        for (const BodyStateSlot& slot : kBodyStateSlots)
            for (int i = 0; i < m_model.body_count(); ++i) look(slot.input, i, gradient.bodies[i].*slot.gradient);
        for (const NodeStateSlot& slot : kNodeStateSlots) look_at_nodes(slot.input, gradient.*slot.gradient);
    }

    void add_control(const RolloutArrays<double>& wanted, const SceneControlGradient& gradient) {
        const auto look_at_bodies = [&](std::size_t k, Vec3 BodyControl::* member) {
            for (int i = 0; wanted[k].present() && i < m_model.body_count(); ++i)
                look(k, i, gradient.bodies[i].*member);
        };
        for_each_input<InputKind::control>(
            look_at_bodies, [&](std::size_t k, std::vector<Vec3> SceneControl::* member) {
                if (wanted[k].present()) look_at_nodes(k, gradient.*member);
            });
    }

    void add_parameters(const RolloutArrays<double>& wanted, const ParameterGradient& gradient) {
        const auto look_at_vector = [&](std::size_t k, Vec3 Parameters::* member) {
            if (wanted[k].present()) look(k, kNobody, gradient.*member);
        };
        const auto look_at_rows = [&](std::size_t k, auto Parameters::* member) {
            for (std::size_t i = 0; wanted[k].present() && i < (gradient.*member).size(); ++i)
                look(k, object_at(i), (gradient.*member)[i]);
        };
        const auto look_at_cloths = [&](std::size_t k, double ClothParameters::* member) {
            for (int c = 0; wanted[k].present() && c < m_model.cloth_count(); ++c)
                look(k, m_model.body_count() + c, gradient.cloths[c].*member);
        };
        for_each_input<InputKind::parameter>(look_at_vector, look_at_rows, look_at_cloths);
    }

    bool any() const { return !m_fault.gradients.empty(); }
    GradientFault& fault() { return m_fault; }

private:
    /// Of rows along the axis of bodies or that of objects.
    int object_at(std::size_t index) const {
        const int object = static_cast<int>(index);
        return object == m_model.body_count() + m_model.cloth_count() ? kGround : object;
    }

    bool look(std::size_t input, int object, double value) { return look(input, object, Vector<1>(value)); }

    template <typename Matrix>
    bool look(std::size_t input, int object, const Matrix& value) {
        if ((value.array().abs() <= m_limit).all()) return true;
        add_once(m_fault.gradients, std::string(kInputs[input].label));
        if (object != kNobody) add_once(m_fault.objects, object);
        return false;
    }

    void look_at_nodes(std::size_t input, const std::vector<Vec3>& values) {
        for (int c = 0; c < m_model.cloth_count(); ++c)
            for (int k = 0; k < m_model.cloths[c].node_count(); ++k) {
                const int node = m_model.cloths[c].first_node + k;
                if (!look(input, m_model.body_count() + c, values[node])) add_once(m_fault.nodes, node);
            }
    }

    template <typename T>
    static void add_once(std::vector<T>& list, const T& entry) {
        if (std::find(list.begin(), list.end(), entry) == list.end()) list.push_back(entry);
    }

    const Model& m_model;
    double m_limit;
    GradientFault m_fault;
};

bool upstream_is_finite(const Model& model, const TrajectoryArrays<const double>& upstream, int time, int scene) {
    for (std::size_t k = 0; k < kStateCount; ++k) {
        if (!upstream[k].present()) continue;
        const double* begin = upstream[k].at(time, scene);
        const int count = row_count(model, kInputs[k].axis) * row_shape(kInputs[k]).axes[0];
        if (!std::all_of(begin, begin + count, [](double x) { return std::isfinite(x); })) return false;
    }
    return true;
}

}  // namespace

std::optional<GradientFault> find_gradient_fault(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& wanted, double limit) {
    bool finite_upstream = true;
    for (int scene = 0; scene < tape.shape.batch; ++scene) {
        StepWorkspace workspace;
        std::optional<GradientFault> fault;
        const auto look = [&](int time, const SceneGradient& gradient, const SceneControlGradient& control) {
            const bool enters = tape.shape.keep_time || time == tape.shape.steps - 1;
            if (enters && !upstream_is_finite(*tape.model, upstream, tape.shape.keep_time ? time : 0, scene)) {
                finite_upstream = false;
                return false;
            }
            FaultCollector found(*tape.model, limit);
            found.add_state(gradient.state);
            found.add_control(wanted, control);
            found.add_parameters(wanted, gradient.parameters);
            if (!found.any()) return true;
            fault = std::move(found.fault());
            fault->scene = scene;
            fault->step = tape.shape.first_step + time;
            std::sort(fault->objects.begin(), fault->objects.end());
            return false;
        };
        scene_backward(tape, inputs, upstream, wanted, scene, false, workspace, look);
        if (fault) return fault;
    }
    if (!finite_upstream) return std::nullopt;
    return GradientFault{};
}

void rollout_backward(
    const Tape& tape, const RolloutInputs& inputs, const TrajectoryArrays<const double>& upstream,
    const RolloutArrays<double>& gradient, int thread_count, Interrupt* interrupt) {
    std::vector<SceneGradient> scenes(static_cast<std::size_t>(tape.shape.batch));
    bool keep_controls = false;
    for (std::size_t k = 0; k < kInputCount; ++k)
        keep_controls = keep_controls || (kind_of(kInputs[k]) == InputKind::control && gradient[k].present());
    for_each_scene(*tape.model, tape.shape.batch, thread_count, interrupt, [&](int scene, StepWorkspace& workspace) {
        scenes[scene] = scene_backward(
            tape, inputs, upstream, gradient, scene, keep_controls, workspace, [](const auto&...) { return true; });
    });
    // Inputs that scenes share get the sum over the scenes, in their order.
    for (int scene = 0; scene < tape.shape.batch; ++scene) write_gradient(tape, inputs, gradient, scene, scenes[scene]);
}

namespace {

/// Call visit(model, options, parameters, control, record) for the last step of a scene; of one in two parts for that
/// which is about velocities, and so about forces.
template <class Visit>
auto with_last_step(const Tape& tape, const RolloutInputs& inputs, int scene, const Visit& visit) {
    const Model& model = *tape.model;
    Options options = tape.options;
    const StepRecord& record = last_part(tape.records[scene].back(), options);
    Workers workers(1);
    SceneControl control;
    read_control(model, inputs, tape.shape.steps - 1, scene, record.start, workers, control);
    if (record.velocities) options.part = StepPart::velocities;
    const StepRecord& part = record.velocities ? *record.velocities : record;
    return visit(model, options, read_parameters(model, inputs, scene), control, part);
}

}  // namespace

std::vector<LinearisedZone> linearised_zones(const Tape& tape, const RolloutInputs& inputs, int scene) {
    return with_last_step(tape, inputs, scene, [](auto&&... step) { return linearised_zones(step...); });
}

std::vector<ContactReadout> last_contacts(const Tape& tape, const RolloutInputs& inputs, int scene) {
    return with_last_step(tape, inputs, scene, [](auto&&... step) { return read_contacts(step...); });
}

}  // namespace diffsim
