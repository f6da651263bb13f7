#pragma once

#include "step/step.hpp"

/// The whole order of one step, in parts where the time scheme has any.
namespace diffsim {

/// As step(), over options.dt at once.
SceneState step_at_once(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
    const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record);

/// Its backward, as step_backward().
void backward_at_once(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient);

/// What a step of this part of dt has for options: its contacts are as stiff, whose compliance is in units of the step.
Options over_part(const Options& options, double part);

}  // namespace diffsim
