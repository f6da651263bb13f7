#pragma once

#include "math/types.hpp"

namespace diffsim {

/// Axis-aligned box. Default constructed it is empty and grows by `include`.
struct Box {
    Vec3 lower = Vec3::Constant(kInfinity);
    Vec3 upper = Vec3::Constant(-kInfinity);

    void include(const Vec3& point) {
        lower = lower.cwiseMin(point);
        upper = upper.cwiseMax(point);
    }
    void include(const Box& other) {
        lower = lower.cwiseMin(other.lower);
        upper = upper.cwiseMax(other.upper);
    }
    void inflate(double amount) {
        lower.array() -= amount;
        upper.array() += amount;
    }
    bool overlaps(const Box& other) const {
        return lower[0] <= other.upper[0] && other.lower[0] <= upper[0] && lower[1] <= other.upper[1] &&
               other.lower[1] <= upper[1] && lower[2] <= other.upper[2] && other.lower[2] <= upper[2];
    }
    Vec3 center() const { return 0.5 * (lower + upper); }
    Vec3 half_extent() const { return 0.5 * (upper - lower); }
};

/// Where a frame sits: x_world = R x_body + t.
struct Pose {
    Mat3 R = Mat3::Identity();
    Vec3 t = Vec3::Zero();

    Vec3 operator*(const Vec3& x_body) const { return R * x_body + t; }
};

/// World box around a body-frame box.
inline Box transformed(const Box& box, const Pose& pose) {
    const Vec3 center = pose * box.center();
    const Vec3 half = pose.R.cwiseAbs() * box.half_extent();
    return {center - half, center + half};
}

}  // namespace diffsim
