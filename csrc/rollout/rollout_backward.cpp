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
        end.bodies[i].orientation = turned(end.bodies[i].orientation, record.y.bodies[i].head<3>());
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
    gradient.parameters.mass.assign(count, 0.0);
    gradient.parameters.inertia.assign(count, Mat3::Zero());
    gradient.parameters.cloths.assign(model.cloths.size(), ClothParameters{});
    gradient.parameters.friction.assign(parameters.friction.size(), 0.0);
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
        // Where a kinematic body was not driven, its own velocity drove it.
        for (std::size_t i = 0; i < count; ++i) {
            if (model.bodies[i].kind != BodyKind::kinematic) continue;
            if (!inputs.body_velocity.present())
                gradient.state.bodies[i].velocity += control_gradient.bodies[i].velocity;
            if (!inputs.body_angular_velocity.present())
                gradient.state.bodies[i].angular_velocity += control_gradient.bodies[i].angular_velocity;
        }
        if (!after_step(time, gradient, control_gradient)) break;
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
    for (std::size_t i = 0; out.friction.present() && i < gradient.parameters.friction.size(); ++i)
        out.friction.at(0, scene)[i] += gradient.parameters.friction[i];
    write_cloth_gradient(*tape.model, out, scene, gradient);
}

// --- gradients that are not finite ---------------------------------------------------------------------------------

/// What of a step's gradients is not finite, or too large.
class FaultCollector {
public:
    FaultCollector(const Model& model, double limit) : m_model(model), m_limit(limit) {}

    void add_state(const SceneStateGradient& gradient) {
        for (int i = 0; i < m_model.body_count(); ++i) {
            const BodyStateGradient& g = gradient.bodies[i];
            look("state.position", i, g.position);
            look("state.orientation", i, g.orientation);
            look("state.velocity", i, g.velocity);
            look("state.angular_velocity", i, g.angular_velocity);
        }
        look_at_nodes("state.node_position", gradient.node_position);
        look_at_nodes("state.node_velocity", gradient.node_velocity);
    }

    void add_control(const RolloutArrays<double>& wanted, const SceneControlGradient& gradient) {
        for (int i = 0; i < m_model.body_count(); ++i) {
            const BodyControl& g = gradient.bodies[i];
            if (wanted.force.present()) look("control.force", i, g.force);
            if (wanted.torque.present()) look("control.torque", i, g.torque);
            if (wanted.body_velocity.present()) look("control.body_velocity", i, g.velocity);
            if (wanted.body_angular_velocity.present()) look("control.body_angular_velocity", i, g.angular_velocity);
        }
        if (wanted.node_force.present()) look_at_nodes("control.node_force", gradient.node_force);
        if (wanted.node_drive.present()) look_at_nodes("control.node_velocity", gradient.node_velocity);
    }

    void add_parameters(const RolloutArrays<double>& wanted, const ParameterGradient& gradient) {
        for (int i = 0; i < m_model.body_count(); ++i) {
            if (wanted.mass.present()) look("mass", i, Vector<1>(gradient.mass[i]));
            if (wanted.inertia.present()) look("inertia", i, gradient.inertia[i]);
        }
        if (wanted.gravity.present()) look("gravity", kNobody, gradient.gravity);
        for (std::size_t i = 0; wanted.friction.present() && i < gradient.friction.size(); ++i)
            look("friction", is_ground(i) ? kGround : static_cast<int>(i), Vector<1>(gradient.friction[i]));
        for (int c = 0; c < m_model.cloth_count(); ++c) {
            const ClothParameters& g = gradient.cloths[c];
            const int object = m_model.body_count() + c;
            if (wanted.cloth_density.present()) look("cloth_density", object, Vector<1>(g.density));
            if (wanted.cloth_stretch.present()) look("cloth_stretch", object, Vector<1>(g.stretch));
            if (wanted.cloth_shear.present()) look("cloth_shear", object, Vector<1>(g.shear));
            if (wanted.cloth_bend.present()) look("cloth_bend", object, Vector<1>(g.bend));
            if (wanted.cloth_damping.present()) look("cloth_damping", object, Vector<1>(g.damping));
        }
    }

    bool is_ground(std::size_t object) const {
        return static_cast<int>(object) == m_model.body_count() + m_model.cloth_count();
    }

    bool any() const { return !m_fault.gradients.empty(); }
    GradientFault& fault() { return m_fault; }

private:
    template <typename Matrix>
    bool look(const char* name, int object, const Matrix& value) {
        if ((value.array().abs() <= m_limit).all()) return true;
        add_once(m_fault.gradients, std::string(name));
        if (object != kNobody) add_once(m_fault.objects, object);
        return false;
    }

    void look_at_nodes(const char* name, const std::vector<Vec3>& values) {
        for (int c = 0; c < m_model.cloth_count(); ++c)
            for (int k = 0; k < m_model.cloths[c].node_count(); ++k) {
                const int node = m_model.cloths[c].first_node + k;
                if (!look(name, m_model.body_count() + c, values[node])) add_once(m_fault.nodes, node);
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
    const auto finite = [&](const BatchedView<const double>& view, int count) {
        const double* begin = view.present() ? view.at(time, scene) : nullptr;
        return begin == nullptr || std::all_of(begin, begin + count, [](double x) { return std::isfinite(x); });
    };
    const int n = model.body_count(), nodes = model.node_count();
    return finite(upstream.position, 3 * n) && finite(upstream.orientation, 4 * n) &&
           finite(upstream.velocity, 3 * n) && finite(upstream.angular_velocity, 3 * n) &&
           finite(upstream.node_position, 3 * nodes) && finite(upstream.node_velocity, 3 * nodes);
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
    const bool keep_controls = gradient.force.present() || gradient.torque.present() || gradient.node_force.present() ||
                               gradient.body_velocity.present() || gradient.body_angular_velocity.present() ||
                               gradient.node_drive.present();
    for_each_scene(*tape.model, tape.shape.batch, thread_count, interrupt, [&](int scene, StepWorkspace& workspace) {
        scenes[scene] = scene_backward(
            tape, inputs, upstream, gradient, scene, keep_controls, workspace, [](const auto&...) { return true; });
    });
    // Inputs that scenes share get the sum over the scenes, in their order.
    for (int scene = 0; scene < tape.shape.batch; ++scene) write_gradient(tape, inputs, gradient, scene, scenes[scene]);
}

namespace {

/// Call visit(model, options, parameters, control, record) for the last step of a scene; of one in two parts for that which
/// is about velocities, and so about forces.
template <class Visit>
auto with_last_step(const Tape& tape, const RolloutInputs& inputs, int scene, const Visit& visit) {
    const Model& model = *tape.model;
    const StepRecord& record = tape.records[scene].back();
    Workers workers(1);
    SceneControl control;
    read_control(model, inputs, tape.shape.steps - 1, scene, record.start, workers, control);
    Options options = tape.options;
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
