#include "step/step.hpp"

#include <Eigen/LU>
#include <algorithm>

#include "math/rotation.hpp"
#include "step/recorded_zones.hpp"
#include "step/thread_memory.hpp"

namespace diffsim {
namespace {

constexpr int kWorthSharing = 64;       // bodies and nodes in zones: fewer are done before a thread has woken up
constexpr int kPortionsPerThread = 32;  // of the zones: they take differently long

}  // namespace

struct StepWorkspace::BackwardScratch {
    std::vector<Vec6> pose_gradient;  ///< along the twist of the body at the end of the step
    std::vector<Vec6> multiplier;
    std::vector<char> in_zone;
    std::vector<SharedGradient> shared;
};

namespace {

/// The backward of one step, body by body and zone by zone.
class StepBackward {
public:
    StepBackward(
        const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
        const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
        SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient)
        : m_model(model),
          m_options(options),
          m_parameters(parameters),
          m_control(control),
          m_record(record),
          m_zones(model, options, parameters, control, record),
          m_needs(needs),
          m_workspace(workspace),
          m(*workspace.backward),
          m_gradient(gradient),
          m_control_gradient(control_gradient),
          m_parameter_gradient(parameter_gradient) {}

    void run() {
        if (m_record.held) return;
        const std::size_t count = m_model.bodies.size();
        m.pose_gradient.assign(count, Vec6::Zero());
        m.multiplier.assign(count, Vec6::Zero());
        m.in_zone.assign(count, 0);
        for (int i : m_record.zones.bodies) m.in_zone[i] = 1;
        solve_zones();
        m_workspace.workers.for_each_range(static_cast<int>(count), kBodiesARange, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) finish_body(i);
        });
        add_gravity();
    }

private:
    /// d(loss)/dy of a body through its state at the end of the step.
    Vec6 upstream(int i) const {
        const BodyStateGradient& g = m_gradient.bodies[i];
        const double dt = m_options.dt;
        Vec6 v;
        v << left_jacobian(m_record.y.bodies[i].head<3>()).transpose() * g.orientation + g.angular_velocity / dt,
            g.position + g.velocity / dt;
        return v;
    }

    Vec3 node_upstream(int i) const { return m_gradient.node_position[i] + m_gradient.node_velocity[i] / m_options.dt; }

    void solve_zones() {
        // Threads write to the zones' own bodies and cloths. What zones share is added up after, in the zones' order.
        const int count = m_zones.count();
        const bool worth_it = !m_record.zones.cloths.empty() || m_record.zones.bodies.size() >= kWorthSharing;
        const int portions = worth_it ? kPortionsPerThread * m_workspace.workers.thread_count() : 1;
        m_workspace.workers.for_each_range(count, std::max(count / portions, 1), [&](int begin, int end, int thread) {
            for (int k = begin; k < end; ++k) solve_zone_adjoint(k, thread);
        });
        m.shared.clear();
        m_workspace.for_each_memory([&](ThreadMemory& memory) {
            std::vector<SharedGradient>& shared = memory.backward.shared;
            m.shared.insert(m.shared.end(), shared.begin(), shared.end());
            shared.clear();
        });
        std::sort(m.shared.begin(), m.shared.end(), [](const SharedGradient& a, const SharedGradient& b) {
            return std::pair(a.zone, a.body) < std::pair(b.zone, b.body);
        });
        for (const SharedGradient& part : m.shared) m.pose_gradient[part.body] += part.pose;
    }

    void finish_body(int i) {
        switch (m_model.bodies[i].kind) {
            case BodyKind::dynamic:
                dynamic_body(i, m.in_zone[i] != 0);
                break;
            case BodyKind::kinematic:
                kinematic_body(i);
                break;
            case BodyKind::static_:
                static_body(i);
                break;
        }
    }

    /// v̂ = v0 + dt (g + f / m): gravity gets dt times what the velocity at the start gets.
    void add_gravity() {
        Vec3 sum = Vec3::Zero();
        for (std::size_t i = 0; i < m_model.bodies.size(); ++i)
            if (m_model.bodies[i].is_dynamic()) sum += m_gradient.bodies[i].velocity;
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
        for (int k = 0; k < zone.dynamic_count; ++k) scratch.upstream.bodies.push_back(upstream(zone.bodies[k].id));
        for (const ZoneCloth& cloth : zone.cloths)
            for (int k = 0; k < m_model.cloths[cloth.id].node_count(); ++k)
                scratch.upstream.nodes.push_back(node_upstream(m_model.cloths[cloth.id].first_node + k));
        const ZoneAdjoint& adjoint =
            zone_adjoint(zone, point, scratch.upstream, m_options.adjoint, m_needs, scratch.adjoint);
        for (int k = 0; k < zone.body_count(); ++k) {
            const int id = zone.bodies[k].id;
            if (k >= zone.dynamic_count) {
                scratch.shared.push_back({index, id, adjoint.pose_gradient.bodies[k]});
                continue;
            }
            m.pose_gradient[id] = adjoint.pose_gradient.bodies[k];
            m.multiplier[id] = adjoint.multiplier.bodies[k];
            m_parameter_gradient.mass[id] += adjoint.mass_gradient[k];
        }
        if (zone.cloths.empty()) return;
        if (m_options.split)
            split_cloths(zone, adjoint, scratch.elastic);
        else
            finish_cloths(zone, adjoint);
    }

    /// Split coupling: carry the contact pass's gradient with respect to its targets on through the elastic pass.
    void split_cloths(const Zone& contact_zone, const ZoneAdjoint& contact, AdjointWorkspace& workspace) {
        for (const ZoneCloth& cloth : contact_zone.cloths) {
            const Cloth& model = m_model.cloths[cloth.id];
            Zone zone;
            make_zone(zone, m_model, m_parameters.cloths, kDefaultCompliance, m_options.dt, contact_zone.origin);
            zone.contacts_off = true;
            ZonePoint point;
            add_cloth(zone, cloth.id, m_record.start, m_control, m_parameters);
            Coordinates upstreams;
            for (int k = 0; k < model.node_count(); ++k) {
                const int node = cloth.first_node + k;
                const Vec3& z = contact.multiplier.nodes[node];
                upstreams.nodes.push_back(contact_zone.nodes[node].mass * z);
                point.y.nodes.push_back(m_record.elastic_shift[model.first_node + k]);
                // of the mass in  m (u - target)
                const Vec3 error =
                    m_record.y.nodes[model.first_node + k] - m_record.elastic_shift[model.first_node + k];
                const double mass_gradient = contact.node_mass_gradient[node] - z.dot(error);
                m_parameter_gradient.cloths[cloth.id].density += mass_gradient * model.node_area[k];
            }
            evaluate(zone, point);
            ZoneAdjoint adjoint = zone_adjoint(zone, point, upstreams, m_options.adjoint, m_needs, workspace);
            for (int k = 0; k < model.node_count(); ++k) {
                const int node = cloth.first_node + k;
                adjoint.pose_gradient.nodes[k] += contact.pose_gradient.nodes[node];
                const int id = model.first_node + k;
                if (zone.nodes[k].pinned) {
                    pinned_node(id, adjoint.pose_gradient.nodes[k], adjoint.start_gradient[k]);
                } else {
                    const Vec3 error = m_record.elastic_shift[id] - zone.nodes[k].target;
                    free_node(
                        cloth.id, k, adjoint.multiplier.nodes[k], error, 0.0,
                        adjoint.pose_gradient.nodes[k] + adjoint.start_gradient[k]);
                }
            }
            add_material(cloth.id, adjoint.cloth_gradient[0]);
        }
    }

    void finish_cloths(const Zone& zone, const ZoneAdjoint& adjoint) {
        for (std::size_t c = 0; c < zone.cloths.size(); ++c) {
            const ZoneCloth& cloth = zone.cloths[c];
            const Cloth& model = m_model.cloths[cloth.id];
            for (int k = 0; k < model.node_count(); ++k) {
                const int node = cloth.first_node + k;
                const Vec3& place = adjoint.pose_gradient.nodes[node];
                if (zone.nodes[node].pinned) {
                    // Their motion is given, but contacts with their features are as stiff as their mass makes them.
                    m_parameter_gradient.cloths[cloth.id].density +=
                        adjoint.node_mass_gradient[node] * model.node_area[k];
                    pinned_node(model.first_node + k, place, adjoint.start_gradient[node]);
                    continue;
                }
                const Vec3 error = m_record.y.nodes[model.first_node + k] - zone.nodes[node].target;
                free_node(
                    cloth.id, k, adjoint.multiplier.nodes[node], error, adjoint.node_mass_gradient[node],
                    place + adjoint.start_gradient[node]);
            }
            add_material(cloth.id, adjoint.cloth_gradient[c]);
        }
    }

    void add_material(int cloth, const ClothParameters& gradient) {
        ClothParameters& sum = m_parameter_gradient.cloths[cloth];
        sum.stretch += gradient.stretch;
        sum.shear += gradient.shear;
        sum.bend += gradient.bend;
        sum.damping += gradient.damping;
    }

    /// A free node with multiplier z of m (u - target) + ... = 0, target = dt (v0 + dt (g + f / m)).
    void free_node(int cloth, int k, const Vec3& z, const Vec3& error, double mass_gradient, const Vec3& place) {
        const Cloth& model = m_model.cloths[cloth];
        const int node = model.first_node + k;
        const double dt = m_options.dt;
        const double mass = m_parameters.cloths[cloth].density * model.node_area[k];
        const Vec3 grad_velocity = dt * mass * z;  // of the velocity at the end of free motion
        const Vec3& force = m_control.node_force[node];
        mass_gradient -= z.dot(error) + dt / (mass * mass) * force.dot(grad_velocity);
        m_parameter_gradient.cloths[cloth].density += mass_gradient * model.node_area[k];
        m_control_gradient.node_force[node] += dt / mass * grad_velocity;
        m_gradient.node_position[node] += place;
        m_gradient.node_velocity[node] = grad_velocity;
    }

    /// A pinned node, whose motion is dt times its given velocity; `start` is the gradient with respect to where it starts
    /// while it ends where it did.
    void pinned_node(int node, const Vec3& place, const Vec3& start) {
        const Vec3 position = m_gradient.node_position[node] + place;
        m_control_gradient.node_velocity[node] += m_gradient.node_velocity[node] + m_options.dt * position;
        m_gradient.node_position[node] = position + start;
        m_gradient.node_velocity[node].setZero();
    }

    void dynamic_body(int i, bool in_zone) {
        const double dt = m_options.dt;
        const BodyState& start = m_record.start.bodies[i];
        const BodyStateGradient up = m_gradient.bodies[i];
        const Vec6& y = m_record.y.bodies[i];
        const FreeRotation& rotation = m_record.free_rotation[i];
        const Mat3 R0 = quaternion_to_matrix(start.orientation);
        const Mat3& inertia_body = m_parameters.inertia[i];
        const double mass = m_parameters.mass[i];

        // M z: what reaches the target ŷ. Without contact M z is the upstream gradient itself.
        Vec6 mass_z = upstream(i);
        Vec3 turn_covector = Vec3::Zero();  // of R0, through M and the contacts
        if (in_zone) {
            const Vec6& z = m.multiplier[i];
            const Mat3 inertia = R0 * inertia_body * R0.transpose();
            mass_z << inertia * z.head<3>(), mass * z.tail<3>();
            const Vec3 target_shift = dt * free_velocity(i, start, m_control.bodies[i], m_parameters, dt);
            const Vec3 turn_error = y.head<3>() - rotation.rotation;
            turn_covector -= inertia_rotation_gradient(inertia, turn_error, z.head<3>());
            if (m_needs.inertia) m_parameter_gradient.inertia[i] -= inertia_body_gradient(R0, turn_error, z.head<3>());
            m_parameter_gradient.mass[i] -= z.tail<3>().dot(y.tail<3>() - target_shift);
        }
        // w1 = ŵ + (turn - target turn) / dt, v1 = v̂ + (shift - dt v̂) / dt = shift / dt
        const Vec3 grad_rotation = mass_z.head<3>() - up.angular_velocity / dt;
        const Vec3 grad_free_velocity = dt * mass_z.tail<3>();
        const FreeRotationGradient free = free_rotation_backward(
            R0, start.angular_velocity, m_control.bodies[i].torque, inertia_body, dt, rotation, up.angular_velocity,
            grad_rotation, m_needs.inertia);
        BodyStateGradient& out = m_gradient.bodies[i];
        const Vec6& pose = m.pose_gradient[i];
        const Vec3 end_covector = up.orientation + pose.head<3>();
        out.orientation = exp_rotation(y.head<3>()).transpose() * end_covector + turn_covector + free.orientation;
        out.position = up.position + pose.tail<3>();
        out.velocity = grad_free_velocity;
        out.angular_velocity = free.angular_velocity;
        if (m_needs.inertia) m_parameter_gradient.inertia[i] += free.inertia_body;
        m_parameter_gradient.mass[i] -= dt / (mass * mass) * m_control.bodies[i].force.dot(grad_free_velocity);
        m_control_gradient.bodies[i].force += dt / mass * grad_free_velocity;
        m_control_gradient.bodies[i].torque += free.torque;
    }

    void kinematic_body(int i) {
        const double dt = m_options.dt;
        BodyStateGradient& g = m_gradient.bodies[i];
        const Vec3 theta = m_record.y.bodies[i].head<3>();
        const Vec3 covector = g.orientation + m.pose_gradient[i].head<3>();
        const Vec3 shift = g.position + m.pose_gradient[i].tail<3>();
        m_control_gradient.bodies[i].angular_velocity +=
            g.angular_velocity + dt * left_jacobian(theta).transpose() * covector;
        m_control_gradient.bodies[i].velocity += g.velocity + dt * shift;
        g.orientation = exp_rotation(theta).transpose() * covector;
        g.position = shift;
        g.velocity.setZero();
        g.angular_velocity.setZero();
    }

    void static_body(int i) {
        m_gradient.bodies[i].orientation += m.pose_gradient[i].head<3>();
        m_gradient.bodies[i].position += m.pose_gradient[i].tail<3>();
    }

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneControl& m_control;
    const StepRecord& m_record;
    const RecordedZones m_zones;
    const GradientNeeds& m_needs;
    StepWorkspace& m_workspace;
    StepWorkspace::BackwardScratch& m;
    SceneStateGradient& m_gradient;
    SceneControlGradient& m_control_gradient;
    ParameterGradient& m_parameter_gradient;
};

}  // namespace

void step_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient) {
    if (!workspace.backward) workspace.backward = std::make_shared<StepWorkspace::BackwardScratch>();
    StepBackward(
        model, options, parameters, control, record, needs, workspace, gradient, control_gradient, parameter_gradient)
        .run();
}

}  // namespace diffsim
