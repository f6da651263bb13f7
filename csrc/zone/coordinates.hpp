#pragma once

#include <vector>

#include "math/types.hpp"

/// The unknowns of a step.
namespace diffsim {

/// Generalized coordinates of a step, or anything with one entry per coordinate: (theta, u) of each body, u of each
/// cloth node.
struct Coordinates {
    std::vector<Vec6> bodies;
    std::vector<Vec3> nodes;

    void assign_zero(std::size_t body_count, std::size_t node_count) {
        bodies.assign(body_count, Vec6::Zero());
        nodes.assign(node_count, Vec3::Zero());
    }
    void resize(std::size_t body_count, std::size_t node_count) {
        bodies.resize(body_count);
        nodes.resize(node_count);
    }
};

}  // namespace diffsim
