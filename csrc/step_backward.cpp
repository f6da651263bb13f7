#include "step.hpp"

#include <Eigen/LU>
#include <algorithm>

#include "contact/adjoint.hpp"
#include "contact/zone_contacts.hpp"
#include "math/rotation.hpp"

namespace diffsim {
namespace {

/// The backward of one step, body by body and zone by zone.
class StepBackward {
public:
    StepBackward(
        const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
        const StepRecord& record, StepWorkspace& workspace, SceneStateGradient& gradient,
        SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient)
        : m_model(model),
          m_options(options),
          m_parameters(parameters),
          m_control(control),
          m_record(record),
          m_workspace(workspace),
          m_gradient(gradient),
          m_control_gradient(control_gradient),
          m_parameter_gradient(parameter_gradient) {}

    void run() {
        if (m_record.held) return;
        const std::size_t count = m_model.bodies.size();
        m_pose_gradient.assign(count, Vec6::Zero());
        m_multiplier.assign(count, Vec6::Zero());
        std::vector<char> in_zone(count, 0);
        int first_body = 0, first_contact = 0;
        for (std::size_t k = 0; k < m_record.zone_body_end.size(); ++k) {
            for (int b = first_body; b < m_record.zone_body_end[k]; ++b) in_zone[m_record.zone_bodies[b]] = 1;
            solve_zone_adjoint(first_body, m_record.zone_body_end[k], first_contact, m_record.zone_contact_end[k]);
            first_body = m_record.zone_body_end[k];
            first_contact = m_record.zone_contact_end[k];
        }
        for (int i = 0; i < static_cast<int>(count); ++i) {
            switch (m_model.bodies[i].kind) {
                case BodyKind::dynamic:
                    dynamic_body(i, in_zone[i] != 0);
                    break;
                case BodyKind::kinematic:
                    kinematic_body(i);
                    break;
                case BodyKind::static_:
                    static_body(i);
                    break;
            }
        }
    }

private:
    /// d(loss)/dy of a body through its state at the end of the step.
    Vec6 upstream(int i) const {
        const BodyStateGradient& g = m_gradient.bodies[i];
        const double dt = m_options.dt;
        Vec6 v;
        v << left_jacobian(m_record.y[i].head<3>()).transpose() * g.orientation + g.angular_velocity / dt,
            g.position + g.velocity / dt;
        return v;
    }

    void solve_zone_adjoint(int first_body, int body_end, int first_contact, int contact_end) {
        Zone& zone = m_workspace.zone_problem;
        zone.model = &m_model;
        set_compliance(zone, m_options.compliance);
        zone.bodies.clear();
        zone.contacts.clear();
        zone.pairs.clear();
        zone.origin = m_record.start.bodies[m_record.zone_bodies[first_body]].position;
        zone.ground_height = m_model.ground.height - zone.origin.z();
        ZonePoint& point = m_workspace.zone.point;
        point.y.clear();
        const auto add_body = [&](int id) {
            const BodyState& state = m_record.start.bodies[id];
            ZoneBody body;
            body.id = id;
            if (m_model.bodies[id].is_dynamic())
                body = moving_body(
                    id, state, m_control.bodies[id], m_parameters, m_record.free_rotation[id], m_options.dt);
            else
                body.start = {quaternion_to_matrix(state.orientation), state.position};
            body.start.t -= zone.origin;
            m_local[id] = static_cast<int>(zone.bodies.size());
            zone.bodies.push_back(body);
            point.y.push_back(m_record.y[id]);
        };
        m_local.resize(m_model.bodies.size(), -1);
        for (int b = first_body; b < body_end; ++b) add_body(m_record.zone_bodies[b]);
        zone.dynamic_count = body_end - first_body;
        for (int c = first_contact; c < contact_end; ++c) {
            const Contact& contact = m_record.contacts[c];
            for (int object : {contact.object_a, contact.object_b})
                if (object >= 0 && m_local[object] < 0) add_body(object);
        }
        for (int c = first_contact; c < contact_end; ++c) {
            const Contact& contact = m_record.contacts[c];
            const int a = m_local[contact.object_a];
            const int b = contact.with_ground() ? kGround : m_local[contact.object_b];
            add_contact(zone, contact, a, b);
            if (zone.hard) {
                ZoneContact& entry = zone.contacts.back();
                entry.shift = m_record.shifts[c];
                entry.range.rest += entry.shift;
            }
            if (b != kGround && a < zone.dynamic_count && b < zone.dynamic_count)
                zone.pairs.emplace_back(std::min(a, b), std::max(a, b));
        }
        std::sort(zone.pairs.begin(), zone.pairs.end());
        zone.pairs.erase(std::unique(zone.pairs.begin(), zone.pairs.end()), zone.pairs.end());
        for (ZoneContact& entry : zone.contacts) {
            if (entry.b == kGround || entry.a >= zone.dynamic_count || entry.b >= zone.dynamic_count) continue;
            const std::pair<int, int> key(std::min(entry.a, entry.b), std::max(entry.a, entry.b));
            entry.pair =
                static_cast<int>(std::lower_bound(zone.pairs.begin(), zone.pairs.end(), key) - zone.pairs.begin());
        }

        evaluate(zone, point);
        bool below_floor = false;
        for (std::size_t k = 0; k < zone.contacts.size(); ++k)
            below_floor = below_floor || point.distances[k] < zone.contacts[k].range.floor;
        if (below_floor) {
            rescue_contacts(zone);
            evaluate(zone, point);
        }
        Coordinates upstreams;
        for (int b = first_body; b < body_end; ++b) upstreams.push_back(upstream(m_record.zone_bodies[b]));
        const ZoneAdjoint adjoint = zone_adjoint(zone, point, upstreams, m_options.adjoint, m_workspace.zone.system);
        for (int k = 0; k < zone.body_count(); ++k) {
            const int id = zone.bodies[k].id;
            m_local[id] = -1;
            m_pose_gradient[id] += adjoint.pose_gradient[k];
            if (k >= zone.dynamic_count) continue;
            m_multiplier[id] = adjoint.multiplier[k];
            m_parameter_gradient.mass[id] += adjoint.mass_gradient[k];
        }
    }

    void dynamic_body(int i, bool in_zone) {
        const double dt = m_options.dt;
        const BodyState& start = m_record.start.bodies[i];
        const BodyStateGradient up = m_gradient.bodies[i];
        const Vec6& y = m_record.y[i];
        const FreeRotation& rotation = m_record.free_rotation[i];
        const Mat3 R0 = quaternion_to_matrix(start.orientation);
        const Mat3& inertia_body = m_parameters.inertia[i];
        const double mass = m_parameters.mass[i];

        // M z: what reaches the target ŷ. Without contact M z is the upstream gradient itself.
        Vec6 mass_z = upstream(i);
        Vec3 turn_covector = Vec3::Zero();  // of R0, through M and the contacts
        if (in_zone) {
            const Vec6& z = m_multiplier[i];
            const Mat3 inertia = R0 * inertia_body * R0.transpose();
            mass_z << inertia * z.head<3>(), mass * z.tail<3>();
            const Vec3 target_shift = dt * free_velocity(i, start, m_control.bodies[i], m_parameters, dt);
            const Vec3 turn_error = y.head<3>() - rotation.rotation;
            turn_covector -= inertia_rotation_gradient(inertia, turn_error, z.head<3>());
            m_parameter_gradient.inertia[i] -= inertia_body_gradient(R0, turn_error, z.head<3>());
            m_parameter_gradient.mass[i] -= z.tail<3>().dot(y.tail<3>() - target_shift);
        }
        // w1 = ŵ + (turn - target turn) / dt, v1 = v̂ + (shift - dt v̂) / dt = shift / dt
        const Vec3 grad_rotation = mass_z.head<3>() - up.angular_velocity / dt;
        const Vec3 grad_free_velocity = dt * mass_z.tail<3>();
        const FreeRotationGradient free = free_rotation_backward(
            R0, start.angular_velocity, m_control.bodies[i].torque, inertia_body, dt, rotation, up.angular_velocity,
            grad_rotation);
        BodyStateGradient& out = m_gradient.bodies[i];
        const Vec6& pose = m_pose_gradient[i];
        const Vec3 end_covector = up.orientation + pose.head<3>();
        out.orientation = exp_rotation(y.head<3>()).transpose() * end_covector + turn_covector + free.orientation;
        out.position = up.position + pose.tail<3>();
        out.velocity = grad_free_velocity;
        out.angular_velocity = free.angular_velocity;
        m_parameter_gradient.inertia[i] += free.inertia_body;
        m_parameter_gradient.gravity += dt * grad_free_velocity;
        m_parameter_gradient.mass[i] -= dt / (mass * mass) * m_control.bodies[i].force.dot(grad_free_velocity);
        m_control_gradient.bodies[i].force += dt / mass * grad_free_velocity;
        m_control_gradient.bodies[i].torque += free.torque;
    }

    void kinematic_body(int i) {
        const double dt = m_options.dt;
        BodyStateGradient& g = m_gradient.bodies[i];
        const Vec3 theta = m_record.y[i].head<3>();
        const Vec3 covector = g.orientation + m_pose_gradient[i].head<3>();
        const Vec3 shift = g.position + m_pose_gradient[i].tail<3>();
        m_control_gradient.bodies[i].angular_velocity +=
            g.angular_velocity + dt * left_jacobian(theta).transpose() * covector;
        m_control_gradient.bodies[i].velocity += g.velocity + dt * shift;
        g.orientation = exp_rotation(theta).transpose() * covector;
        g.position = shift;
        g.velocity.setZero();
        g.angular_velocity.setZero();
    }

    void static_body(int i) {
        m_gradient.bodies[i].orientation += m_pose_gradient[i].head<3>();
        m_gradient.bodies[i].position += m_pose_gradient[i].tail<3>();
    }

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneControl& m_control;
    const StepRecord& m_record;
    StepWorkspace& m_workspace;
    SceneStateGradient& m_gradient;
    SceneControlGradient& m_control_gradient;
    ParameterGradient& m_parameter_gradient;
    std::vector<Vec6> m_pose_gradient;  // along the twist of the body at the end of the step
    Coordinates m_multiplier;
    std::vector<int> m_local;  // index in the zone at hand, by body
};

}  // namespace

void step_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient) {
    StepBackward(model, options, parameters, control, record, workspace, gradient, control_gradient, parameter_gradient)
        .run();
}

}  // namespace diffsim
