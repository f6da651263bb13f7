#pragma once

#include <vector>

#include "math/types.hpp"

namespace diffsim {

/// One rigid body: the pose of its centre of mass and its velocities, in the world frame.
struct BodyState {
    Vec3 position = Vec3::Zero();          ///< [m]
    Vec4 orientation = Vec4(1, 0, 0, 0);   ///< unit quaternion w, x, y, z: body to world
    Vec3 velocity = Vec3::Zero();          ///< [m/s]
    Vec3 angular_velocity = Vec3::Zero();  ///< [rad/s]
};

/// Everything that moves.
struct SceneState {
    std::vector<BodyState> bodies;
    std::vector<Vec3> node_position;  ///< of all cloths, one after the other, world frame [m]
    std::vector<Vec3> node_velocity;  ///< [m/s]
};

/// What drives one body during a step.
struct BodyControl {
    Vec3 force = Vec3::Zero();             ///< world frame, at the centre of mass [N]
    Vec3 torque = Vec3::Zero();            ///< world frame [N·m]
    Vec3 velocity = Vec3::Zero();          ///< of a kinematic body [m/s]
    Vec3 angular_velocity = Vec3::Zero();  ///< of a kinematic body [rad/s]
};

/// What drives a scene during a step.
struct SceneControl {
    std::vector<BodyControl> bodies;
    std::vector<Vec3> node_force;     ///< world frame [N]
    std::vector<Vec3> node_velocity;  ///< of pinned nodes [m/s]
};

/// d(loss)/d(SceneControl).
using SceneControlGradient = SceneControl;

/// d(loss)/d(BodyState), with the orientation's as a rotation covector (math/rotation.hpp).
struct BodyStateGradient {
    Vec3 position = Vec3::Zero();
    Vec3 orientation = Vec3::Zero();
    Vec3 velocity = Vec3::Zero();
    Vec3 angular_velocity = Vec3::Zero();
};

/// d(loss)/d(SceneState).
struct SceneStateGradient {
    std::vector<BodyStateGradient> bodies;
    std::vector<Vec3> node_position, node_velocity;
};

}  // namespace diffsim
