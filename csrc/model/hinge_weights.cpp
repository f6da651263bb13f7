#include "model/hinge_weights.hpp"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

namespace diffsim {
namespace {

using Vec2 = Eigen::Vector2d;

/// Curvatures that the hinges around tell this much less of than of others count as not told: squared ratio of singular
/// values. Small meshes and corners tell less than three; on irregular meshes ratios are 0.3 and more.
constexpr double kLeastTold = 0.05 * 0.05;

/// Couplings below this part of the hinges' own weights are left out. Those of regular grids vanish but for rounding,
/// that of their coordinates in a single precision file included, and each would cost up to 16 blocks of the Hessian.
constexpr double kLeastCoupling = 1e-5;

/// A symmetric tensor as (11, 22, √2 12), so that the dot product is the tensors' own.
Vec3 symmetric(const Vec2& a, const Vec2& b) {
    return {a.x() * b.x(), a.y() * b.y(), std::sqrt(0.5) * (a.x() * b.y() + a.y() * b.x())};
}

/// An edge seen in the plane of one of its triangles.
struct EdgeFrame {
    Vec2 along, inward;  ///< unit: from the edge's first node to its second, and from the edge into the triangle
};

/// A triangle laid into the plane.
struct FlatTriangle {
    std::array<int, 3> nodes;
    std::array<Vec2, 3> corners;
    double area;
    std::array<int, 3> hinges = {-1, -1, -1};  ///< opposite each corner; -1 where the edge has no other triangle

    const Vec2& corner(int node) const {
        return corners[static_cast<std::size_t>(std::find(nodes.begin(), nodes.end(), node) - nodes.begin())];
    }
    EdgeFrame frame(const Vec2& from, const Vec2& to) const {
        EdgeFrame frame;
        frame.along = (to - from).normalized();
        frame.inward = {-frame.along.y(), frame.along.x()};
        const Vec2 centre = (corners[0] + corners[1] + corners[2]) / 3.0;
        if (frame.inward.dot(centre - from) < 0.0) frame.inward = -frame.inward;
        return frame;
    }
};

FlatTriangle flatten(const std::vector<Vec3>& rest, const std::array<int, 3>& nodes) {
    const Vec3 edge1 = rest[nodes[1]] - rest[nodes[0]], edge2 = rest[nodes[2]] - rest[nodes[0]];
    const Vec3 u = edge1.normalized();
    const double along = u.dot(edge2), up = (edge2 - along * u).norm(), length = edge1.norm();
    return {nodes, {Vec2::Zero(), Vec2(length, 0.0), Vec2(along, up)}, 0.5 * length * up};
}

/// Coefficients of the curvatures across the edge (n), mixed and along it (t), n pointing to side a.
struct EdgeCoefficients {
    double nn, nt, tt;

    Vec3 tensor(const Vec2& n, const Vec2& t) const {
        return nn * symmetric(n, n) + nt * symmetric(n, t) + tt * symmetric(t, t);
    }
};

/// A hinge on the surface w = ½ xᵀ κ x. With the corners at heights h and feet s along the edge of length l, the slope
/// in the direction n is ½ h_a κ_nn + s_a κ_nt + q_a κ_tt on side a and -(½ h_b κ_nn - s_b κ_nt + q_b κ_tt) on side b,
/// with q = ½ s (s - l) / h, and ½ l κ_nt in the middle of the edge.
struct FlatHinge {
    double length;
    EdgeCoefficients angle;      ///< slope of a minus slope of b
    EdgeCoefficients deviation;  ///< slope in the middle minus the mean of both sides'
};

FlatHinge flatten(const std::vector<Vec3>& rest, const RestHinge& hinge) {
    const Vec3 p0 = rest[hinge.nodes[0]], edge = rest[hinge.nodes[1]] - p0;
    const double l = edge.norm();
    double s[2], h[2], q[2];
    for (int side = 0; side < 2; ++side) {
        const Vec3 arm = rest[hinge.nodes[2 + side]] - p0;
        s[side] = arm.dot(edge) / l;
        h[side] = (arm - s[side] / l * edge).norm();
        q[side] = 0.5 * s[side] * (s[side] - l) / h[side];
    }
    return {
        l,
        {0.5 * (h[0] + h[1]), s[0] - s[1], q[0] + q[1]},
        {-0.25 * (h[0] - h[1]), 0.5 * (l - s[0] - s[1]), -0.5 * (q[0] - q[1])}};
}

/// A linear function of the hinges' angles.
template <class Value>
using Row = std::vector<std::pair<int, Value>>;

class WeightBuilder {
public:
    WeightBuilder(
        const std::vector<Vec3>& rest, const std::vector<std::array<int, 3>>& triangles,
        const std::vector<RestHinge>& hinges)
        : m_hinges(hinges) {
        for (const std::array<int, 3>& nodes : triangles) m_triangles.push_back(flatten(rest, nodes));
        for (int h = 0; h < static_cast<int>(hinges.size()); ++h) {
            m_flat.push_back(flatten(rest, hinges[h]));
            for (int side = 0; side < 2; ++side) {
                FlatTriangle& triangle = m_triangles[hinges[h].triangles[side]];
                for (int k = 0; k < 3; ++k)
                    if (triangle.nodes[k] == hinges[h].nodes[2 + side]) triangle.hinges[k] = h;
            }
        }
    }

    HingeWeights build() const {
        std::vector<Row<double>> deviations;
        for (int h = 0; h < static_cast<int>(m_hinges.size()); ++h) deviations.push_back(deviation(h));
        HingeWeights result;
        result.diagonal.assign(m_hinges.size(), 0.0);
        for (int t = 0; t < static_cast<int>(m_triangles.size()); ++t) {
            const Row<Vec3> curvature = triangle_curvature(t, deviations);
            for (std::size_t i = 0; i < curvature.size(); ++i) {
                for (std::size_t j = i; j < curvature.size(); ++j) {
                    const double weight = m_triangles[t].area * curvature[i].second.dot(curvature[j].second);
                    if (i == j)
                        result.diagonal[curvature[i].first] += weight;
                    else
                        result.couplings.push_back({curvature[i].first, curvature[j].first, weight});
                }
            }
        }
        merge(result);
        return result;
    }

private:
    EdgeFrame frame(int hinge, int side) const {
        const FlatTriangle& triangle = m_triangles[m_hinges[hinge].triangles[side]];
        return triangle.frame(triangle.corner(m_hinges[hinge].nodes[0]), triangle.corner(m_hinges[hinge].nodes[1]));
    }
    int side_of(int hinge, int triangle) const { return m_hinges[hinge].triangles[0] == triangle ? 0 : 1; }

    /// Whether a hinge's angle is measured about the side that a triangle's own numbering makes its normal's: 1 or -1.
    double sense(int hinge, int triangle) const {
        const std::array<int, 3>& nodes = m_triangles[triangle].nodes;
        const int first = m_hinges[hinge].nodes[side_of(hinge, triangle)];
        const int second = m_hinges[hinge].nodes[1 - side_of(hinge, triangle)];
        for (int k = 0; k < 3; ++k)
            if (nodes[k] == first) return nodes[(k + 1) % 3] == second ? 1.0 : -1.0;
        return 1.0;  // not reached: both are corners of the triangle
    }

    /// φ of a hinge as a function of the angles around, in least squares.
    Row<double> deviation(int hinge) const {
        const EdgeFrame a = frame(hinge, 0), b = frame(hinge, 1);
        // Turns the plane of side b into that of side a, continued beyond the edge.
        const Eigen::Matrix2d unfold = a.along * b.along.transpose() - a.inward * b.inward.transpose();
        Row<Vec3> angles;
        for (int side = 0; side < 2; ++side) {
            const int triangle = m_hinges[hinge].triangles[side];
            for (const int other : m_triangles[triangle].hinges) {
                if (other < 0 || (other == hinge && side == 1)) continue;
                EdgeFrame edge = frame(other, side_of(other, triangle));
                if (side == 1) edge = {unfold * edge.along, unfold * edge.inward};
                if (side_of(other, triangle) == 1) edge.inward = -edge.inward;
                const double sign = sense(hinge, triangle) * sense(other, triangle);
                angles.emplace_back(other, sign * m_flat[other].angle.tensor(edge.inward, edge.along));
            }
        }
        Mat3 normal = Mat3::Zero();
        for (const auto& [id, row] : angles) normal += row * row.transpose();
        const Eigen::SelfAdjointEigenSolver<Mat3> eigen(normal);
        Mat3 inverse = Mat3::Zero();
        for (int k = 0; k < 3; ++k) {
            if (eigen.eigenvalues()[k] <= kLeastTold * eigen.eigenvalues()[2]) continue;
            const Vec3 axis = eigen.eigenvectors().col(k);
            inverse += axis * axis.transpose() / eigen.eigenvalues()[k];
        }
        const Vec3 covector = inverse * m_flat[hinge].deviation.tensor(a.inward, a.along);
        Row<double> result;
        for (const auto& [id, row] : angles) result.emplace_back(id, row.dot(covector));
        return result;
    }

    /// B_T, sorted by hinge.
    Row<Vec3> triangle_curvature(int t, const std::vector<Row<double>>& deviations) const {
        const FlatTriangle& triangle = m_triangles[t];
        Row<Vec3> row;
        Mat3 free =
            Mat3::Zero();  // columns: orthonormal directions of curvature that edges without a hinge take for nothing
        int free_count = 0;
        for (int k = 0; k < 3; ++k) {
            const int hinge = triangle.hinges[k];
            if (hinge < 0) {
                const Vec2 n = triangle.frame(triangle.corners[(k + 1) % 3], triangle.corners[(k + 2) % 3]).inward;
                Vec3 direction = symmetric(n, n);
                for (int j = 0; j < free_count; ++j) direction -= free.col(j).dot(direction) * free.col(j);
                free.col(free_count++) = direction.normalized();
                continue;
            }
            const int side = side_of(hinge, t);
            const Vec2 n = frame(hinge, side).inward;
            const Vec3 tensor = sense(hinge, t) * m_flat[hinge].length / triangle.area * symmetric(n, n);
            row.emplace_back(hinge, 0.5 * tensor);
            for (const auto& [id, weight] : deviations[hinge])
                row.emplace_back(id, (side == 0 ? -weight : weight) * tensor);
        }
        std::stable_sort(row.begin(), row.end(), [](const auto& x, const auto& y) { return x.first < y.first; });
        Row<Vec3> merged;
        for (const auto& [id, tensor] : row) {
            if (merged.empty() || merged.back().first != id) merged.emplace_back(id, Vec3::Zero());
            merged.back().second += tensor;
        }
        for (auto& [id, tensor] : merged) tensor -= free * (free.transpose() * tensor).eval();
        return merged;
    }

    /// Add up equal pairs and leave out the negligible ones, to the benefit of the diagonal: W stays semidefinite.
    static void merge(HingeWeights& weights) {
        std::vector<HingeCoupling>& list = weights.couplings;
        std::stable_sort(list.begin(), list.end(), [](const HingeCoupling& x, const HingeCoupling& y) {
            return std::pair(x.a, x.b) < std::pair(y.a, y.b);
        });
        const std::vector<double> own = weights.diagonal;
        std::size_t kept = 0;
        for (std::size_t k = 0; k < list.size();) {
            HingeCoupling sum = list[k++];
            while (k < list.size() && list[k].a == sum.a && list[k].b == sum.b) sum.weight += list[k++].weight;
            if (std::abs(sum.weight) > kLeastCoupling * std::sqrt(own[sum.a] * own[sum.b])) {
                list[kept++] = sum;
            } else {
                weights.diagonal[sum.a] += std::abs(sum.weight);
                weights.diagonal[sum.b] += std::abs(sum.weight);
            }
        }
        list.resize(kept);
    }

    const std::vector<RestHinge>& m_hinges;
    std::vector<FlatTriangle> m_triangles;
    std::vector<FlatHinge> m_flat;
};

}  // namespace

HingeWeights hinge_weights(
    const std::vector<Vec3>& rest, const std::vector<std::array<int, 3>>& triangles,
    const std::vector<RestHinge>& hinges) {
    return WeightBuilder(rest, triangles, hinges).build();
}

}  // namespace diffsim
