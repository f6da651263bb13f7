#include <algorithm>
#include <iterator>
#include <memory>
#include <utility>

#include "step/group_step.hpp"
#include "step/step.hpp"
#include "step/step_part.hpp"

namespace diffsim {
namespace {

/// Without bodies both parts of a step would be the same.
bool in_two_parts(const Model& model, const Options& options) {
    return options.integrator == Integrator::trapezoidal &&
           std::any_of(model.bodies.begin(), model.bodies.end(), [](const Body& body) { return body.is_dynamic(); });
}

Options for_part(const Options& options, StepPart part) {
    Options result = options;
    result.part = part;
    return result;
}

/// Let what is said of the places speak of the velocities, too: contacts are those of the places.
void add_info(const StepInfo& velocities, StepInfo& info) {
    if (!velocities.converged) {
        if (info.converged) info.status = velocities.status;
        info.converged = false;
    }
    info.add_effort(velocities);
    info.fast_impacts = std::max(info.fast_impacts, velocities.fast_impacts);
    info.signature = mix(info.signature, velocities.signature);
    std::vector<int> failed;
    std::set_union(
        info.failed_objects.begin(), info.failed_objects.end(), velocities.failed_objects.begin(),
        velocities.failed_objects.end(), std::back_inserter(failed));
    info.failed_objects = std::move(failed);
}

void take_velocities(const SceneState& from, SceneState& to) {
    for (std::size_t i = 0; i < to.bodies.size(); ++i) {
        to.bodies[i].velocity = from.bodies[i].velocity;
        to.bodies[i].angular_velocity = from.bodies[i].angular_velocity;
    }
    to.node_velocity = from.node_velocity;
}

/// Of a gradient what is about velocities; the rest is left to `gradient`.
SceneStateGradient split_off_velocities(SceneStateGradient& gradient) {
    SceneStateGradient velocities;
    for (BodyStateGradient& body : gradient.bodies) {
        BodyStateGradient own;
        std::swap(own.velocity, body.velocity);
        std::swap(own.angular_velocity, body.angular_velocity);
        velocities.bodies.push_back(own);
    }
    velocities.node_position.assign(gradient.node_velocity.size(), Vec3::Zero());
    velocities.node_velocity = velocities.node_position;
    std::swap(velocities.node_velocity, gradient.node_velocity);
    return velocities;
}

void add_to(SceneStateGradient& sum, const SceneStateGradient& part) {
    for (std::size_t i = 0; i < sum.bodies.size(); ++i) {
        sum.bodies[i].position += part.bodies[i].position;
        sum.bodies[i].orientation += part.bodies[i].orientation;
        sum.bodies[i].velocity += part.bodies[i].velocity;
        sum.bodies[i].angular_velocity += part.bodies[i].angular_velocity;
    }
    for (std::size_t i = 0; i < sum.node_position.size(); ++i) {
        sum.node_position[i] += part.node_position[i];
        sum.node_velocity[i] += part.node_velocity[i];
    }
}

}  // namespace

SceneState step(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
    const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record) {
    if (!in_two_parts(model, options))
        return solve_part(model, options, parameters, state, control, workspace, info, record);
    const auto solve = [&](StepPart part, StepInfo& part_info, StepRecord* part_record) {
        return solve_part(
            model, for_part(options, part), parameters, state, control, workspace, part_info, part_record);
    };
    StepInfo velocity_info;
    std::unique_ptr<StepRecord> velocity_record = record != nullptr ? std::make_unique<StepRecord>() : nullptr;
    const SceneState velocities = solve(StepPart::velocities, velocity_info, velocity_record.get());
    if (velocity_info.status == StepStatus::overflow)
        return hold(state, StepStatus::overflow, velocity_info.failed_objects, info, record);
    SceneState result = solve(StepPart::places, info, record);
    if (info.status == StepStatus::overflow) return result;
    take_velocities(velocities, result);
    add_info(velocity_info, info);
    if (record != nullptr) record->velocities = std::move(velocity_record);
    return result;
}

void step_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient) {
    const auto backward = [&](const Options& part, const StepRecord& part_record, SceneStateGradient& part_gradient) {
        part_backward(
            model, part, parameters, control, part_record, needs, workspace, part_gradient, control_gradient,
            parameter_gradient);
    };
    if (!record.velocities) return backward(options, record, gradient);
    SceneStateGradient velocities = split_off_velocities(gradient);
    backward(for_part(options, StepPart::places), record, gradient);
    backward(for_part(options, StepPart::velocities), *record.velocities, velocities);
    add_to(gradient, velocities);
}

}  // namespace diffsim
