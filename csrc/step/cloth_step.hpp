#pragma once

#include "adjoint/adjoint.hpp"
#include "geometry/box.hpp"
#include "model/state.hpp"
#include "step/step_setting.hpp"
#include "zone/zone.hpp"

/// The time scheme of one cloth: how its step begins, how it ends, and the backward of both. Implicit Euler, or the
/// second of two stages (dynamics/two_stages.hpp) where the setting knows of a first.
namespace diffsim {

/// Append a cloth at the start of a step to a zone, whose origin is set.
void add_cloth(Zone& zone, int id, const StepSetting& setting, const SceneState& state, const SceneControl& control);

/// The cloth's part of the state after the motion `shift`, one per node of the scene. `as_told`: nothing was held up,
/// and pinned nodes have the velocity they were given.
void end_cloth(
    const StepSetting& setting, int id, const SceneControl& control, const std::vector<Vec3>& shift, bool as_told,
    SceneState& state);

/// Space for a cloth from where it is to where its nodes would go: world frame, margins included.
Box space_of_cloth(const StepSetting& setting, int id, const SceneState& state, const SceneControl& control);

/// Whether numbers are too small to hold a cloth, at the start of the step, where `state` moves
/// as it is driven, or at its end.
bool cloth_overflows(const StepSetting& setting, int id, const SceneState& state, const SceneControl& control);

// --- backward

/// d(loss)/dy of a node through its state at the end of the step.
Vec3 node_upstream(const SceneStateGradient& end, int node, double dt);

/// Carries the gradient at the end of a step back to its start, cloth by cloth.
class ClothBackward {
public:
    /// `start`, `y`: state at the start of the step, and its motion. `gradient` is
    /// overwritten, the last two are added to, and so is that of the setting's first stage, if it has one.
    ClothBackward(
        const StepSetting& setting, const SceneState& start, const SceneControl& control, const Coordinates& y,
        SceneStateGradient& gradient, SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient,
        std::vector<Vec3>* first_stage_gradient)
        : m_setting(setting),
          m_start(start),
          m_control(control),
          m_y(y),
          m_gradient(gradient),
          m_control_gradient(control_gradient),
          m_parameter_gradient(parameter_gradient),
          m_first_stage_gradient(first_stage_gradient) {}

    /// The cloths of a zone that was solved at once.
    void finish(const Zone& zone, const ZoneAdjoint& adjoint);

    /// Split coupling: carry the contact pass's gradient with respect to its targets on through the elastic pass, in
    /// which nodes moved by `elastic_shift`.
    void finish_split(
        const Zone& contact_zone, const ZoneAdjoint& contact, const std::vector<Vec3>& elastic_shift, AdjointMode mode,
        const GradientNeeds& needs, AdjointWorkspace& workspace);

private:
    void start_elastic_pass(
        const Zone& contact_zone, const ZoneAdjoint& contact, const ZoneCloth& cloth,
        const std::vector<Vec3>& elastic_shift, Zone& zone, ZonePoint& point, Coordinates& upstream);
    void add_material(int cloth, const ClothParameters& gradient);
    void add_first_stage(const Zone& zone, const ZoneAdjoint& adjoint, const ZoneCloth& cloth);
    void free_node(int cloth, int k, const Vec3& z, const Vec3& error, double mass_gradient, const Vec3& pose);
    void pinned_node(int node, const Vec3& pose, const Vec3& start, const Vec3& drive);

    StepSetting m_setting;
    const SceneState& m_start;
    const SceneControl& m_control;
    const Coordinates& m_y;
    SceneStateGradient& m_gradient;
    SceneControlGradient& m_control_gradient;
    ParameterGradient& m_parameter_gradient;
    std::vector<Vec3>* m_first_stage_gradient;  // one per node of the scene
};

}  // namespace diffsim
