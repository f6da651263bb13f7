#include "step/time_scheme.hpp"

#include <algorithm>
#include <iterator>
#include <memory>
#include <utility>

#include "dynamics/two_stages.hpp"
#include "step/group_step.hpp"
#include "step/step_part.hpp"

namespace diffsim {
namespace {

/// Without cloth or bodies that yield all schemes are the same.
bool in_parts(const Model& model, const Options& options) {
    const auto yields = [](const Body& body) { return body.is_dynamic(); };
    return options.integrator == Integrator::second_order &&
           (model.cloth_count() > 0 || std::any_of(model.bodies.begin(), model.bodies.end(), yields));
}

Options for_part(const Options& options, StepPart part) {
    Options result = part == StepPart::first_stage ? over_part(options, kStage) : options;
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

SceneStateGradient zero_like(const SceneStateGradient& gradient) {
    SceneStateGradient result;
    result.bodies.resize(gradient.bodies.size());
    result.node_position.assign(gradient.node_position.size(), Vec3::Zero());
    result.node_velocity = result.node_position;
    return result;
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

Options over_part(const Options& options, double part) {
    Options result = options;
    result.dt *= part;
    result.compliance /= part * part;
    return result;
}

SceneState step_at_once(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
    const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record) {
    std::vector<Vec3> first_stage;
    SceneState velocities;
    const auto solve = [&](StepPart part, StepInfo& part_info, StepRecord* part_record) {
        const Options of_part = for_part(options, part);
        return solve_part(
            {model, parameters, of_part.dt, part, &first_stage, &velocities.node_velocity}, of_part, state, control,
            workspace, part_info, part_record);
    };
    if (!in_parts(model, options)) return solve(StepPart::whole, info, record);
    const auto new_record = [&] { return record != nullptr ? std::make_unique<StepRecord>() : nullptr; };
    std::unique_ptr<StepRecord> stage_record, velocity_record = new_record();
    StepInfo stage_info, velocity_info;
    const auto overflown = [](const StepInfo& part) { return part.status == StepStatus::overflow; };
    const auto hold_all = [&](const StepInfo& part) {
        return hold(state, StepStatus::overflow, part.failed_objects, info, record);
    };
    if (model.cloth_count() > 0) {
        stage_record = new_record();
        SceneState end = solve(StepPart::first_stage, stage_info, stage_record.get());
        if (overflown(stage_info)) return hold_all(stage_info);
        first_stage = std::move(end.node_position);
    }
    velocities = solve(StepPart::velocities, velocity_info, velocity_record.get());
    if (overflown(velocity_info)) return hold_all(velocity_info);
    SceneState result = solve(StepPart::places, info, record);
    if (overflown(info)) return result;
    take_velocities(velocities, result);
    add_info(velocity_info, info);
    if (model.cloth_count() > 0) add_info(stage_info, info);
    if (record == nullptr) return result;
    record->velocities = std::move(velocity_record);
    record->stage = std::move(stage_record);
    return result;
}

void backward_at_once(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient) {
    std::vector<Vec3> of_first_stage(record.first_stage.size(), Vec3::Zero());
    const auto backward = [&](StepPart part, const StepRecord& part_record, SceneStateGradient& part_gradient) {
        GradientNeeds part_needs = needs;
        part_needs.place =
            needs.place || !part_record.first_stage.empty();  // it leads to what the first stage depends on
        part_backward(
            model, for_part(options, part), parameters, control, part_record, part_needs, workspace, part_gradient,
            control_gradient, parameter_gradient, &of_first_stage);
    };
    if (!record.velocities) return backward(StepPart::whole, record, gradient);
    SceneStateGradient velocities = split_off_velocities(gradient);
    SceneStateGradient stage;
    if (record.stage) stage = zero_like(gradient);
    backward(StepPart::places, record, gradient);
    backward(StepPart::velocities, *record.velocities, velocities);
    add_to(gradient, velocities);
    if (!record.stage) return;
    stage.node_position = std::move(of_first_stage);
    backward(StepPart::first_stage, *record.stage, stage);
    add_to(gradient, stage);
}

}  // namespace diffsim
