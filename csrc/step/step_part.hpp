#pragma once

#include "step/step.hpp"

/// One solve of a step, for what options.part says, and its backward: with implicit Euler they are the step.
namespace diffsim {

/// As step(). What the part is not for is in the state, too, and means nothing. `setting` and `options` agree.
SceneState solve_part(
    const StepSetting& setting, const Options& options, const SceneState& state, const SceneControl& control,
    StepWorkspace& workspace, StepInfo& info, StepRecord* record);

/// As step_backward(). `first_stage_gradient`, of StepRecord::first_stage, is added to; null where that is empty.
void part_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient,
    std::vector<Vec3>* first_stage_gradient);

}  // namespace diffsim
