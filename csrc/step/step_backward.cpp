#include "step/step.hpp"

#include <algorithm>

#include "step/body_step.hpp"
#include "step/cloth_step.hpp"
#include "step/recorded_zones.hpp"
#include "step/step_part.hpp"
#include "step/thread_memory.hpp"

namespace diffsim {

struct StepWorkspace::BackwardScratch {
    std::vector<Vec6> pose_gradient;   ///< along the twist of the body at the end of the step
    std::vector<Vec6> drive_gradient;  ///< along the motion of a driven body
    std::vector<Vec6> multiplier;
    std::vector<char> in_zone;
    std::vector<SharedGradient> shared;
    std::vector<FrictionGradient> friction;
};

namespace {

/// The backward of one step, body by body and zone by zone.
class StepBackward {
public:
    StepBackward(
        const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
        const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
        SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient,
        std::vector<Vec3>* first_stage_gradient)
        : m_model(model),
          m_options(options),
          m_setting(setting_of(model, options, parameters, record)),
          m_control(control),
          m_record(record),
          m_zones(model, options, parameters, control, record),
          m_needs(needs),
          m_workspace(workspace),
          m_scratch(*workspace.backward),
          m_gradient(gradient),
          m_control_gradient(control_gradient),
          m_parameter_gradient(parameter_gradient),
          m_first_stage_gradient(first_stage_gradient) {}

    void run() {
        if (m_record.held) return;
        const std::size_t count = m_model.bodies.size();
        m_scratch.pose_gradient.assign(count, Vec6::Zero());
        m_scratch.drive_gradient.assign(count, Vec6::Zero());
        m_scratch.multiplier.assign(count, Vec6::Zero());
        m_scratch.in_zone.assign(count, 0);
        for (int i : m_record.zones.bodies) m_scratch.in_zone[i] = 1;
        solve_zones();
        m_workspace.workers.for_each_range(static_cast<int>(count), kBodiesARange, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) finish_body(i);
        });
        add_gravity();
    }

private:
    void solve_zones() {
        // Threads write to the zones' own bodies and cloths. What zones share is added up after, in the zones' order.
        const int count = m_zones.count();
        const bool worth_it = !m_record.zones.cloths.empty() || m_record.zones.bodies.size() >= kWorthSharing;
        const int portions = worth_it ? kPortionsPerThread * m_workspace.workers.thread_count() : 1;
        m_workspace.workers.for_each_range(count, std::max(count / portions, 1), [&](int begin, int end, int thread) {
            for (int k = begin; k < end; ++k) solve_zone_adjoint(k, thread);
        });
        m_scratch.shared.clear();
        m_workspace.for_each_memory([&](ThreadMemory& memory) {
            std::vector<SharedGradient>& shared = memory.backward.shared;
            m_scratch.shared.insert(m_scratch.shared.end(), shared.begin(), shared.end());
            shared.clear();
        });
        std::sort(
            m_scratch.shared.begin(), m_scratch.shared.end(), [](const SharedGradient& a, const SharedGradient& b) {
                return std::pair(a.zone, a.body) < std::pair(b.zone, b.body);
            });
        for (const SharedGradient& part : m_scratch.shared) {
            m_scratch.pose_gradient[part.body] += part.pose;
            m_scratch.drive_gradient[part.body] += part.drive;
        }
        add_friction();
    }

    /// Objects are in several zones, the ground in all.
    void add_friction() {
        std::vector<FrictionGradient>& parts = m_scratch.friction;
        parts.clear();
        m_workspace.for_each_memory([&](ThreadMemory& memory) {
            parts.insert(parts.end(), memory.backward.friction.begin(), memory.backward.friction.end());
            memory.backward.friction.clear();
        });
        std::stable_sort(parts.begin(), parts.end(), [](const FrictionGradient& a, const FrictionGradient& b) {
            return a.zone < b.zone;
        });
        for (const FrictionGradient& part : parts)
            m_parameter_gradient.friction[static_cast<std::size_t>(part.object)] += part.value;
    }

    void finish_body(int i) {
        body_backward(
            m_setting, i, m_record.start.bodies[i], m_control.bodies[i], m_record.free_rotation[i],
            m_record.y.bodies[i],
            {m_scratch.in_zone[i] != 0, m_scratch.multiplier[i], m_scratch.pose_gradient[i],
             m_scratch.drive_gradient[i]},
            m_needs, m_gradient.bodies[i], m_control_gradient.bodies[i], m_parameter_gradient);
    }

    /// v̂ = v0 + dt (g + f / m): gravity gets dt times what the velocity at the start gets, from a body that moves by
    /// its mean velocity half of that.
    void add_gravity() {
        Vec3 sum = Vec3::Zero();
        for (std::size_t i = 0; i < m_model.bodies.size(); ++i)
            if (m_model.bodies[i].is_dynamic()) sum += m_gradient.bodies[i].velocity;
        sum *= m_setting.acceleration_time() / m_options.dt;
        for (const Cloth& cloth : m_model.cloths)
            for (int k = 0; k < cloth.node_count(); ++k)
                if (!cloth.pinned[k]) sum += m_gradient.node_velocity[cloth.first_node + k];
        m_parameter_gradient.gravity += m_options.dt * sum;
    }

    void solve_zone_adjoint(int index, int thread) {
        ZoneMemory& memory = m_workspace.memory(thread).zone;
        ZoneBackwardScratch& scratch = m_workspace.memory(thread).backward;
        m_zones.rebuild(index, memory, scratch.local);
        const Zone& zone = memory.zone;
        const ZonePoint& point = memory.workspace.point;
        scratch.upstream.resize(0, 0);
        for (int k = 0; k < zone.dynamic_count; ++k) {
            const int id = zone.bodies[k].id;
            scratch.upstream.bodies.push_back(
                body_upstream(m_gradient.bodies[id], m_record.y.bodies[id], m_options.dt));
        }
        for (const ZoneCloth& cloth : zone.cloths)
            for (int k = 0; k < m_model.cloths[cloth.id].node_count(); ++k)
                scratch.upstream.nodes.push_back(
                    node_upstream(m_gradient, m_model.cloths[cloth.id].first_node + k, m_options.dt));
        const ZoneAdjoint& adjoint = zone_adjoint(
            zone, point, memory.workspace.friction, scratch.upstream, m_options.adjoint, m_needs, scratch.adjoint);
        for (const ZoneAdjoint::FrictionPart& part : adjoint.friction_gradient)
            scratch.friction.push_back({index, part.object, part.value});
        for (int k = 0; k < zone.body_count(); ++k) {
            const int id = zone.bodies[k].id;
            if (k >= zone.dynamic_count) {
                scratch.shared.push_back(
                    {index, id, adjoint.pose_gradient.bodies[k], adjoint.drive_gradient.bodies[k]});
                continue;
            }
            m_scratch.pose_gradient[id] = adjoint.pose_gradient.bodies[k];
            m_scratch.multiplier[id] = adjoint.multiplier.bodies[k];
            m_parameter_gradient.mass[id] += adjoint.mass_gradient[k];
        }
        if (zone.cloths.empty()) return;
        ClothBackward cloths(
            m_setting, m_record.start, m_control, m_record.y, m_gradient, m_control_gradient, m_parameter_gradient,
            m_first_stage_gradient);
        if (m_options.split)
            cloths.finish_split(zone, adjoint, m_record.elastic_shift, m_options.adjoint, m_needs, scratch.elastic);
        else
            cloths.finish(zone, adjoint);
    }

    const Model& m_model;
    const Options& m_options;
    const StepSetting m_setting;
    const SceneControl& m_control;
    const StepRecord& m_record;
    const RecordedZones m_zones;
    const GradientNeeds& m_needs;
    StepWorkspace& m_workspace;
    StepWorkspace::BackwardScratch& m_scratch;
    SceneStateGradient& m_gradient;
    SceneControlGradient& m_control_gradient;
    ParameterGradient& m_parameter_gradient;
    std::vector<Vec3>* m_first_stage_gradient;
};

}  // namespace

void part_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient,
    std::vector<Vec3>* first_stage_gradient) {
    if (!workspace.backward) workspace.backward = std::make_shared<StepWorkspace::BackwardScratch>();
    StepBackward(
        model, options, parameters, control, record, needs, workspace, gradient, control_gradient, parameter_gradient,
        first_stage_gradient)
        .run();
}

}  // namespace diffsim
