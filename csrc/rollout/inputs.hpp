#pragma once

#include <stdexcept>
#include <string>

#include "rollout/rollout.hpp"

/// The arrays of the Python layer as the core's structs. What makes no sense is refused by std::invalid_argument, which
/// names body, node or cloth, the field and the value.
namespace diffsim {

template <int Rows>
Eigen::Map<const Eigen::Matrix<double, Rows, 1>> row(const double* data, int index) {
    return Eigen::Map<const Eigen::Matrix<double, Rows, 1>>(data + Rows * index);
}

template <int Rows>
Eigen::Map<Eigen::Matrix<double, Rows, 1>> row(double* data, int index) {
    return Eigen::Map<Eigen::Matrix<double, Rows, 1>>(data + Rows * index);
}

/// Do work; what it refuses is refused with, say, "in step 3" at the end of the message if there are several.
template <typename Work>
void located(bool several, const char* name, int index, const Work& work) {
    try {
        work();
    } catch (const std::invalid_argument& error) {
        if (!several) throw;
        throw std::invalid_argument(error.what() + std::string(", in ") + name + " " + std::to_string(index));
    }
}

/// Of a kinematic body, the velocity that a control takes the place of; null for controls that push dynamic bodies.
inline Vec3 BodyState::* velocity_driven_by(Vec3 BodyControl::* member) {
    if (member == &BodyControl::velocity) return &BodyState::velocity;
    if (member == &BodyControl::angular_velocity) return &BodyState::angular_velocity;
    return nullptr;
}

/// Whether a control moves kinematic bodies, or pinned nodes, and does not push what moves freely.
inline bool drives(Vec3 BodyControl::* member) { return velocity_driven_by(member) != nullptr; }
inline bool drives(std::vector<Vec3> SceneControl::* member) { return member == &SceneControl::node_velocity; }

SceneState read_state(const Model& model, const RolloutInputs& in, int scene);

/// Steps keep what is apart apart; what crosses to begin with they would keep crossed.
void refuse_crossing(const Model& model, const SceneState& state);

Parameters read_parameters(const Model& model, const RolloutInputs& in, int scene);

/// Kinematic bodies that are not driven keep the velocities of `state`.
void read_control(
    const Model& model, const RolloutInputs& in, int time, int scene, const SceneState& state, Workers& workers,
    SceneControl& control);

}  // namespace diffsim
