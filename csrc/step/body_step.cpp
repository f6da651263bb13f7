#include "step/body_step.hpp"

#include <Eigen/LU>
#include <algorithm>

#include "collision/candidates.hpp"
#include "dynamics/conserving_rotation.hpp"
#include "math/rotation.hpp"
#include "zone/motion_bounds.hpp"

namespace diffsim {
namespace {

/// Velocity of a body that nothing touches: v0 + t (g + f / m), at the end of the step or, where it
/// is for places, in the middle.
Vec3 free_velocity(const StepSetting& setting, int id, const BodyState& state, const BodyControl& control) {
    return state.velocity +
           setting.acceleration_time() * (setting.parameters.gravity + control.force / setting.parameters.mass[id]);
}

/// How a body turns that nothing touches. Where the step is for velocities it turns by dt w1, if that is an angle at
/// all, so that what contact leaves of the turn is the velocity it leaves.
FreeRotation free_turn(const StepSetting& setting, int id, const BodyState& state, const BodyControl& control) {
    const auto solve = setting.by_implicit_euler() ? free_rotation : conserving_rotation;
    FreeRotation result = solve(
        quaternion_to_matrix(state.orientation), state.angular_velocity, control.torque, setting.parameters.inertia[id],
        setting.dt);
    if (setting.part == StepPart::velocities && result.substeps == 1)
        result.rotation = setting.dt * result.angular_velocity;
    return result;
}

FreeRotationGradient free_turn_backward(
    const StepSetting& setting, int id, const BodyState& state, const BodyControl& control,
    const FreeRotation& rotation, Vec3 grad_angular_velocity, Vec3 grad_rotation, bool with_inertia) {
    if (setting.part == StepPart::velocities && rotation.substeps == 1) {
        grad_angular_velocity += setting.dt * grad_rotation;
        grad_rotation.setZero();
    }
    const auto backward = setting.by_implicit_euler() ? free_rotation_backward : conserving_rotation_backward;
    return backward(
        quaternion_to_matrix(state.orientation), state.angular_velocity, control.torque, setting.parameters.inertia[id],
        setting.dt, rotation, grad_angular_velocity, grad_rotation, with_inertia);
}

}  // namespace

BodyStart begin_body(const StepSetting& setting, int id, const BodyState& state, const BodyControl& control) {
    BodyStart start;
    switch (setting.model.bodies[id].kind) {
        case BodyKind::dynamic:
            start.rotation = free_turn(setting, id, state, control);
            start.body = moving_body(setting, id, state, control, start.rotation);
            start.motion = start.body.target;
            break;
        case BodyKind::kinematic:
            start.motion << setting.dt * control.angular_velocity, setting.dt * control.velocity;
            break;
        case BodyKind::static_:
            break;
    }
    return start;
}

ZoneBody moving_body(
    const StepSetting& setting, int id, const BodyState& state, const BodyControl& control,
    const FreeRotation& rotation) {
    const double dt = setting.dt;
    ZoneBody body;
    body.id = id;
    body.start = {quaternion_to_matrix(state.orientation), state.position};
    body.inertia = body.start.R * setting.parameters.inertia[id] * body.start.R.transpose();
    body.weight = setting.body_weight();
    body.inertia *= body.weight;
    body.inverse_inertia = body.inertia.inverse();
    body.mass = body.weight * setting.parameters.mass[id];
    body.target << rotation.rotation, dt * free_velocity(setting, id, state, control);
    body.last_motion << dt * state.angular_velocity, dt * state.velocity;
    if (rotation.substeps == 0) body.last_motion.head<3>().setZero();  // it is held
    return body;
}

BodyState end_body(
    const StepSetting& setting, const BodyStart& start, int id, const BodyState& state, const BodyControl& control,
    const Vec6& y, bool as_told) {
    const double dt = setting.dt;
    const Vec3 turn = y.head<3>(), shift = y.tail<3>();
    BodyState end = state;
    end.orientation = turned(state.orientation, turn);
    end.position += shift;
    switch (setting.model.bodies[id].kind) {
        case BodyKind::dynamic:
            // w1 = turn / dt and v1 = shift / dt, written so that free bodies keep exactly what free motion gives.
            end.angular_velocity = start.rotation.angular_velocity + (turn - start.rotation.rotation) / dt;
            end.velocity = free_velocity(setting, id, state, control) + (shift - start.body.target.tail<3>()) / dt;
            break;
        case BodyKind::kinematic:
            end.angular_velocity = as_told ? control.angular_velocity : Vec3(turn / dt);
            end.velocity = as_told ? control.velocity : Vec3(shift / dt);
            break;
        case BodyKind::static_:
            break;
    }
    return end;
}

Vec4 turned(const Vec4& orientation, const Vec3& turn) {
    if (turn.isZero(0.0)) return orientation;
    Vec4 result = quaternion_multiply(exp_quaternion(turn), orientation);
    result /= result.norm();
    return result;
}

Box space_of_body(const Model& model, const ZoneBody& body) {
    const CollisionMesh& mesh = model.bodies[body.id].mesh;
    const double arc = std::max(sagitta(body.target, mesh.radius), sagitta(body.last_motion, mesh.radius));
    const double reach = model.bodies[body.id].margin + 0.5 * model.own_thickness(body.id) + arc;
    Box box = swept_box({&mesh, {pose_at(body, body.last_motion), pose_at(body, body.target)}, reach});
    Box start = transformed(mesh.tree.nodes[0].box, body.start);
    start.inflate(reach);
    box.include(start);
    return box;
}

Box space_of_driven_body(const Model& model, int id, const Pose& start, const Vec6& motion) {
    const CollisionMesh& mesh = model.bodies[id].mesh;
    ZoneBody driven;
    driven.start = start;
    const double reach = model.bodies[id].margin + sagitta(motion, mesh.radius);
    return swept_box({&mesh, {start, pose_at(driven, motion)}, reach});
}

bool body_overflows(const BodyState& state, const Vec6& motion, double dt) {
    const double dt_sq = std::min(dt * dt, 1.0);
    return !(motion.squaredNorm() <= kLargestSquare * dt_sq && state.position.squaredNorm() <= kLargestSquare);
}

// --- backward --------------------------------------------------------------------------------------------------------

Vec6 body_upstream(const BodyStateGradient& end, const Vec6& y, double dt) {
    Vec6 v;
    v << left_jacobian(y.head<3>()).transpose() * end.orientation + end.angular_velocity / dt,
        end.position + end.velocity / dt;
    return v;
}

namespace {

void kinematic_backward(
    const Vec6& y, double dt, const Vec6& pose, const Vec6& drive, BodyStateGradient& gradient,
    BodyControl& control_gradient) {
    const Vec3 theta = y.head<3>();
    const Vec3 covector = gradient.orientation + pose.head<3>();
    const Vec3 shift = gradient.position + pose.tail<3>();
    control_gradient.angular_velocity +=
        gradient.angular_velocity + dt * (left_jacobian(theta).transpose() * covector + drive.head<3>());
    control_gradient.velocity += gradient.velocity + dt * (shift + drive.tail<3>());
    gradient.orientation = exp_rotation(theta).transpose() * covector;
    gradient.position = shift;
    gradient.velocity.setZero();
    gradient.angular_velocity.setZero();
}

void dynamic_backward(
    const StepSetting& setting, int id, const BodyState& state, const BodyControl& control,
    const FreeRotation& rotation, const Vec6& y, const BodyAdjoint& adjoint, const GradientNeeds& needs,
    BodyStateGradient& gradient, BodyControl& control_gradient, ParameterGradient& parameter_gradient) {
    const double dt = setting.dt;
    const BodyStateGradient up = gradient;
    const Mat3 R0 = quaternion_to_matrix(state.orientation);
    const Mat3& inertia_body = setting.parameters.inertia[id];
    const double mass = setting.parameters.mass[id], weight = setting.body_weight();

    // M z: what reaches the target ŷ. Without contact M z is the upstream gradient itself.
    Vec6 mass_z = body_upstream(up, y, dt);
    Vec3 turn_covector = Vec3::Zero();  // of R0, through M and the contacts
    if (adjoint.in_zone) {
        const Vec6& z = adjoint.multiplier;
        Mat3 inertia = R0 * inertia_body * R0.transpose();
        inertia *= weight;
        mass_z << inertia * z.head<3>(), weight * mass * z.tail<3>();
        const Vec3 target_shift = dt * free_velocity(setting, id, state, control);
        const Vec3 turn_error = y.head<3>() - rotation.rotation;
        turn_covector -= inertia_rotation_gradient(inertia, turn_error, z.head<3>());
        if (needs.inertia)
            parameter_gradient.inertia[id] -= weight * inertia_body_gradient(R0, turn_error, z.head<3>());
        parameter_gradient.mass[id] -= weight * z.tail<3>().dot(y.tail<3>() - target_shift);
    }
    // w1 = ŵ + (turn - target turn) / dt, v1 = v̂ + (shift - dt v̂) / dt = shift / dt
    const Vec3 grad_rotation = mass_z.head<3>() - up.angular_velocity / dt;
    const Vec3 grad_free_velocity = dt * mass_z.tail<3>();
    const FreeRotationGradient free =
        free_turn_backward(setting, id, state, control, rotation, up.angular_velocity, grad_rotation, needs.inertia);
    const Vec3 end_covector = up.orientation + adjoint.pose.head<3>();
    gradient.orientation = exp_rotation(y.head<3>()).transpose() * end_covector + turn_covector + free.orientation;
    gradient.position = up.position + adjoint.pose.tail<3>();
    gradient.velocity = grad_free_velocity;
    gradient.angular_velocity = free.angular_velocity;
    if (needs.inertia) parameter_gradient.inertia[id] += free.inertia_body;
    const double time = setting.acceleration_time();
    parameter_gradient.mass[id] -= time / (mass * mass) * control.force.dot(grad_free_velocity);
    control_gradient.force += time / mass * grad_free_velocity;
    control_gradient.torque += free.torque;
}

}  // namespace

void body_backward(
    const StepSetting& setting, int id, const BodyState& state, const BodyControl& control,
    const FreeRotation& rotation, const Vec6& y, const BodyAdjoint& adjoint, const GradientNeeds& needs,
    BodyStateGradient& gradient, BodyControl& control_gradient, ParameterGradient& parameter_gradient) {
    switch (setting.model.bodies[id].kind) {
        case BodyKind::dynamic:
            dynamic_backward(
                setting, id, state, control, rotation, y, adjoint, needs, gradient, control_gradient,
                parameter_gradient);
            break;
        case BodyKind::kinematic:
            kinematic_backward(y, setting.dt, adjoint.pose, adjoint.drive, gradient, control_gradient);
            break;
        case BodyKind::static_:
            gradient.orientation += adjoint.pose.head<3>();
            gradient.position += adjoint.pose.tail<3>();
            break;
    }
}

}  // namespace diffsim
