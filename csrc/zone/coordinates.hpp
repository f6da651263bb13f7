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

inline double dot(const Coordinates& a, const Coordinates& b) {
    double sum = 0.0;
    for (std::size_t i = 0; i < a.bodies.size(); ++i) sum += a.bodies[i].dot(b.bodies[i]);
    for (std::size_t i = 0; i < a.nodes.size(); ++i) sum += a.nodes[i].dot(b.nodes[i]);
    return sum;
}

/// sum += factor * a
inline void add(double factor, const Coordinates& a, Coordinates& sum) {
    for (std::size_t i = 0; i < a.bodies.size(); ++i) sum.bodies[i] += factor * a.bodies[i];
    for (std::size_t i = 0; i < a.nodes.size(); ++i) sum.nodes[i] += factor * a.nodes[i];
}

/// How many numbers they are.
inline int count(const Coordinates& a) { return static_cast<int>(6 * a.bodies.size() + 3 * a.nodes.size()); }

/// a *= factor
inline void scale(double factor, Coordinates& a) {
    for (Vec6& value : a.bodies) value *= factor;
    for (Vec3& value : a.nodes) value *= factor;
}

}  // namespace diffsim
