#include "model/cloth.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "geometry/dihedral.hpp"

namespace diffsim {
namespace {

using Triangle = Eigen::Vector3i;

/// A triangle lower than this part of its longest edge counts as degenerate: single precision files make
/// triangles out of points on a line that are about 1e-7 high.
constexpr double kMinRelativeHeight = 1e-6;

/// Sine of the warp's angle with a triangle's normal below which it says too little about a direction in the triangle.
constexpr double kMinWarpSine = 0.1;

std::string describe(const Triangle& t) {
    return "(" + std::to_string(t[0]) + ", " + std::to_string(t[1]) + ", " + std::to_string(t[2]) + ")";
}

Vec3 second_axis(const Vec3& warp) {
    Eigen::Index axis;
    warp.cwiseAbs().minCoeff(&axis);
    return Vec3::Unit(axis);
}

ClothTriangle build_triangle(const std::vector<Vec3>& rest, const std::vector<Triangle>& triangles, int id, Vec3 warp) {
    const Triangle& t = triangles[id];
    const Vec3 edge1 = rest[t[1]] - rest[t[0]], edge2 = rest[t[2]] - rest[t[0]];
    Vec3 normal = edge1.cross(edge2);
    const double doubled_area = normal.norm();
    const double longest_sq = std::max({edge1.squaredNorm(), edge2.squaredNorm(), (edge2 - edge1).squaredNorm()});
    if (!(doubled_area > kMinRelativeHeight * longest_sq))
        throw std::invalid_argument(
            "triangle " + std::to_string(id) + " " + describe(t) + " has no area, or corners that are not finite");
    normal /= doubled_area;
    if (normal.cross(warp).norm() < kMinWarpSine) warp = second_axis(warp);
    const Vec3 u = (warp - normal * normal.dot(warp)).normalized(), v = normal.cross(u);

    Eigen::Matrix2d shape;
    shape << u.dot(edge1), u.dot(edge2), v.dot(edge1), v.dot(edge2);
    return {{t[0], t[1], t[2]}, shape.inverse(), 0.5 * doubled_area};
}

int opposite_corner(const ClothTriangle& triangle, const std::pair<int, int>& edge) {
    for (const int node : triangle.nodes)
        if (node != edge.first && node != edge.second) return node;
    return -1;  // not reached: a triangle with area has three corners
}

ClothHinge build_hinge(const Cloth& cloth, const std::pair<int, int>& edge, const std::vector<int>& around) {
    const ClothTriangle &a = cloth.triangles[around[0]], &b = cloth.triangles[around[1]];
    ClothHinge hinge;
    hinge.nodes = {edge.first, edge.second, opposite_corner(a, edge), opposite_corner(b, edge)};
    if (hinge.nodes[2] == hinge.nodes[3])
        throw std::invalid_argument(
            "triangles " + std::to_string(around[0]) + " and " + std::to_string(around[1]) + " have the same corners");
    Mat34 points;
    for (int k = 0; k < 4; ++k) points.col(k) = cloth.rest[hinge.nodes[k]];
    hinge.rest_angle = dihedral_frame(points).angle;
    hinge.weight = 0.0;  // follows from all of them
    return hinge;
}

/// Weights and couplings of the hinges, each between the two triangles `around` it.
void weigh_hinges(Cloth& cloth, const std::vector<std::array<int, 2>>& around) {
    std::vector<std::array<int, 3>> triangles;
    for (const ClothTriangle& triangle : cloth.triangles) triangles.push_back(triangle.nodes);
    std::vector<RestHinge> hinges;
    for (std::size_t h = 0; h < around.size(); ++h) hinges.push_back({cloth.hinges[h].nodes, around[h]});
    HingeWeights weights = hinge_weights(cloth.rest, triangles, hinges);
    for (std::size_t h = 0; h < around.size(); ++h) cloth.hinges[h].weight = weights.diagonal[h];
    cloth.couplings = std::move(weights.couplings);
}

/// Every pair of nodes of one element.
void list_node_pairs(Cloth& cloth) {
    const auto couple = [&](const auto& nodes_a, const auto& nodes_b) {
        for (const int i : nodes_a)
            for (const int j : nodes_b)
                if (i != j) cloth.node_pairs.emplace_back(std::min(i, j), std::max(i, j));
    };
    for (const ClothTriangle& triangle : cloth.triangles) couple(triangle.nodes, triangle.nodes);
    for (const ClothHinge& hinge : cloth.hinges) couple(hinge.nodes, hinge.nodes);
    for (const HingeCoupling& coupling : cloth.couplings)
        couple(cloth.hinges[coupling.a].nodes, cloth.hinges[coupling.b].nodes);
    std::sort(cloth.node_pairs.begin(), cloth.node_pairs.end());
    cloth.node_pairs.erase(std::unique(cloth.node_pairs.begin(), cloth.node_pairs.end()), cloth.node_pairs.end());
}

}  // namespace

Cloth build_cloth(std::vector<Vec3> rest, const std::vector<Triangle>& triangles, const Vec3& warp) {
    const double warp_length = warp.norm();
    if (!(warp_length > 0.0) || !std::isfinite(warp_length))
        throw std::invalid_argument("the warp direction must be finite and not zero");
    if (triangles.empty()) throw std::invalid_argument("a cloth needs at least one triangle");
    Cloth cloth;
    cloth.rest = std::move(rest);
    const std::size_t node_count = cloth.rest.size();
    cloth.pinned.assign(node_count, 0);
    cloth.node_area.assign(node_count, 0.0);
    for (int id = 0; id < static_cast<int>(triangles.size()); ++id) {
        if (triangles[id].minCoeff() < 0 || triangles[id].maxCoeff() >= cloth.node_count())
            throw std::invalid_argument(
                "triangle " + std::to_string(id) + " " + describe(triangles[id]) + ": node out of range");
        cloth.triangles.push_back(build_triangle(cloth.rest, triangles, id, warp / warp_length));
        for (const int node : cloth.triangles.back().nodes) cloth.node_area[node] += cloth.triangles.back().area / 3.0;
    }
    for (std::size_t node = 0; node < node_count; ++node)
        if (cloth.node_area[node] == 0.0)
            throw std::invalid_argument("node " + std::to_string(node) + " belongs to no triangle");
    std::vector<std::array<int, 2>> around_hinge;
    for (const auto& [edge, around] : collect_edge_faces(triangles)) {
        if (around.size() > 2)
            throw std::invalid_argument(
                "edge (" + std::to_string(edge.first) + ", " + std::to_string(edge.second) + ") belongs to " +
                std::to_string(around.size()) + " triangles, at most two can meet");
        if (around.size() < 2) continue;
        cloth.hinges.push_back(build_hinge(cloth, edge, around));
        around_hinge.push_back({around[0], around[1]});
    }
    weigh_hinges(cloth, around_hinge);
    list_node_pairs(cloth);
    cloth.surface = build_collision_mesh(cloth.rest, triangles, Faces::separate);
    return cloth;
}

}  // namespace diffsim
