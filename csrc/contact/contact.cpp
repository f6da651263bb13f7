#include "contact/contact.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <array>
#include <cmath>

#include "collision/ccd.hpp"
#include "math/rotation.hpp"

namespace diffsim {
namespace {

/// World positions of a patch's corners; on the stack for all but unusual patches.
class Corners {
public:
    Corners(const CollisionMesh& mesh, int patch, const Pose& pose) {
        const std::vector<int>& loop = mesh.patches[patch].vertices;
        m_count = static_cast<int>(loop.size());
        if (m_count > kSmall) m_large.resize(loop.size());
        Vec3* corners = m_count > kSmall ? m_large.data() : m_small.data();
        for (int k = 0; k < m_count; ++k) corners[k] = pose * mesh.vertices[loop[k]];
    }
    const Vec3* data() const { return m_count > kSmall ? m_large.data() : m_small.data(); }
    int count() const { return m_count; }

private:
    static constexpr int kSmall = 16;
    std::array<Vec3, kSmall> m_small;
    std::vector<Vec3> m_large;
    int m_count;
};

ClosestPoints swapped(const ClosestPoints& points) {
    ClosestPoints result = points;
    std::swap(result.point_a, result.point_b);
    std::swap(result.slide_count_a, result.slide_count_b);
    std::swap(result.slide_a, result.slide_b);
    return result;
}

/// A vertex of `mesh_v` against a patch of `mesh_p`.
ClosestPoints vertex_against_patch(
    const CollisionMesh& mesh_v, int vertex, const Pose& pose_v, const CollisionMesh& mesh_p, int patch,
    const Pose& pose_p) {
    const Corners corners(mesh_p, patch, pose_p);
    return closest_vertex_polygon(
        pose_v * mesh_v.vertices[vertex], {corners.data(), corners.count(), pose_p.R * mesh_p.patches[patch].normal});
}

/// ½ (r nᵀ + n rᵀ) - (n·r) I: second derivative of n · Exp(phi) r at phi = 0.
Mat3 turn_curvature(const Vec3& r, const Vec3& n) {
    Mat3 m = 0.5 * (r * n.transpose() + n * r.transpose());
    m.diagonal().array() -= n.dot(r);
    return m;
}

/// The directions in which the closest points slide, as motions of their offset w = point_a - point_b, and how a turn
/// of the sliding object changes them along n.
struct Slides {
    int count = 0;
    std::array<Vec3, 2> direction;  ///< dw/ds
    std::array<Vec12, 2> turn;      ///< n · d(dw/ds)/d(twist)
};

Slides collect_slides(const ContactGeometry& geometry) {
    const ClosestPoints& points = geometry.closest;
    Slides slides;
    const auto add = [&](const Vec3& slide, double sign, int offset) {
        slides.direction[slides.count] = sign * slide;
        slides.turn[slides.count].setZero();
        slides.turn[slides.count].segment<3>(offset) = sign * slide.cross(geometry.normal);
        ++slides.count;
    };
    for (int k = 0; k < points.slide_count_a; ++k) add(points.slide_a[k], 1.0, 0);
    for (int k = 0; k < points.slide_count_b; ++k) add(points.slide_b[k], -1.0, 6);
    return slides;
}

/// Second derivative of the distance d = min over the slides s of |w(twist, s)|. With W = dw/d(twist), S = dw/ds,
/// G = (SᵀS)⁻¹, q = n · dS/d(twist), and N the projector on what is orthogonal to S and n:
///     WᵀNW/d - WᵀSGq - (WᵀSGq)ᵀ - d qᵀGq + n · d²w/d(twist)².
Mat12 distance_hessian(const ContactGeometry& geometry, const Vec3& arm_a, const Vec3& arm_b) {
    const Vec3& n = geometry.normal;
    const double d = geometry.distance;
    Eigen::Matrix<double, 3, 12> W;
    W << -skew(arm_a), Mat3::Identity(), skew(arm_b), -Mat3::Identity();

    Mat12 hessian = Mat12::Zero();
    hessian.block<3, 3>(0, 0) = turn_curvature(arm_a, n);
    hessian.block<3, 3>(6, 6) = -turn_curvature(arm_b, n);

    const Slides slides = collect_slides(geometry);
    if (slides.count == 0) {
        const Mat3 N = Mat3::Identity() - n * n.transpose();
        hessian += W.transpose() * N * W / d;
        return hessian;
    }
    Eigen::Matrix<double, 2, 12> q = Eigen::Matrix<double, 2, 12>::Zero();
    Eigen::Matrix<double, 2, 12> SW = Eigen::Matrix<double, 2, 12>::Zero();
    for (int k = 0; k < slides.count; ++k) {
        q.row(k) = slides.turn[k];
        SW.row(k) = slides.direction[k].transpose() * W;
    }
    Eigen::Matrix2d G = Eigen::Matrix2d::Identity();
    if (slides.count == 1) {
        const Vec3 binormal = n.cross(slides.direction[0]);
        const Eigen::Matrix<double, 1, 12> BW = binormal.transpose() * W;
        hessian += BW.transpose() * BW / d;
    } else {
        const double g = slides.direction[0].dot(slides.direction[1]);
        const double determinant = slides.direction[0].cross(slides.direction[1]).squaredNorm();
        G << 1.0, -g, -g, 1.0;
        G /= determinant;
    }
    const Mat12 mixed = SW.transpose() * G * q;
    hessian -= mixed + mixed.transpose() + d * (q.transpose() * G * q);
    return hessian;
}

/// The squared sine c = 1 - g² of the angle between two edges, g the cosine, and its derivatives.
struct AngleDerivatives {
    Vec12 gradient;
    Mat12 hessian;
};

AngleDerivatives angle_derivatives(const Vec3& a, const Vec3& b) {
    const double g = a.dot(b);
    Vec12 g_gradient = Vec12::Zero();
    g_gradient.segment<3>(0) = a.cross(b);
    g_gradient.segment<3>(6) = b.cross(a);
    Mat12 g_hessian = Mat12::Zero();
    g_hessian.block<3, 3>(0, 0) = turn_curvature(a, b);
    g_hessian.block<3, 3>(6, 6) = turn_curvature(b, a);
    const Mat3 cross_block = g * Mat3::Identity() - b * a.transpose();
    g_hessian.block<3, 3>(0, 6) = cross_block;
    g_hessian.block<3, 3>(6, 0) = cross_block.transpose();
    return {-2.0 * g * g_gradient, -2.0 * (g_gradient * g_gradient.transpose() + g * g_hessian)};
}

}  // namespace

ContactGeometry contact_geometry(
    const Model& model, const Contact& contact, const Pose& pose_a, const Pose& pose_b, double ground_height) {
    ContactGeometry geometry;
    const CollisionMesh& mesh_a = model.bodies[contact.object_a].mesh;
    if (contact.with_ground()) {
        ClosestPoints& points = geometry.closest;
        points.point_a = pose_a * mesh_a.vertices[contact.feature_a];
        points.point_b = Vec3(points.point_a.x(), points.point_a.y(), ground_height);
        geometry.distance = points.point_a.z() - ground_height;
        geometry.normal = Vec3::UnitZ();
        return geometry;
    }
    const CollisionMesh& mesh_b = model.bodies[contact.object_b].mesh;
    switch (contact.type) {
        case ContactType::vertex_patch:
            geometry.closest =
                vertex_against_patch(mesh_a, contact.feature_a, pose_a, mesh_b, contact.feature_b, pose_b);
            break;
        case ContactType::patch_vertex:
            geometry.closest =
                swapped(vertex_against_patch(mesh_b, contact.feature_b, pose_b, mesh_a, contact.feature_a, pose_a));
            break;
        case ContactType::edge_edge: {
            const Edge& edge_a = mesh_a.edges[contact.feature_a];
            const Edge& edge_b = mesh_b.edges[contact.feature_b];
            const Vec3 a0 = pose_a * mesh_a.vertices[edge_a.p0], a1 = pose_a * mesh_a.vertices[edge_a.p1];
            const Vec3 b0 = pose_b * mesh_b.vertices[edge_b.p0], b1 = pose_b * mesh_b.vertices[edge_b.p1];
            geometry.closest = closest_edge_edge(a0, a1, b0, b1);
            const Vec3 da = a1 - a0, db = b1 - b0;
            geometry.sine_sq = da.cross(db).squaredNorm() / (da.squaredNorm() * db.squaredNorm());
            if (geometry.sine_sq < kParallelLimit) {
                geometry.direction_a = da.normalized();
                geometry.direction_b = db.normalized();
            }
            break;
        }
    }
    const Vec3 offset = geometry.closest.point_a - geometry.closest.point_b;
    geometry.distance = offset.norm();
    geometry.normal = geometry.distance > 0.0 ? Vec3(offset / geometry.distance) : Vec3(Vec3::Zero());
    return geometry;
}

double contact_toi(
    const Model& model, const Contact& contact, const Sweep& sweep_a, const Sweep& sweep_b, double ground_height,
    const CcdOptions& options) {
    const CollisionMesh& mesh_a = model.bodies[contact.object_a].mesh;
    if (contact.with_ground()) {
        const Vec3& x = mesh_a.vertices[contact.feature_a];
        return plane_toi((sweep_a.begin * x).z() - ground_height, (sweep_a.end * x).z() - ground_height, options);
    }
    const CollisionMesh& mesh_b = model.bodies[contact.object_b].mesh;
    if (contact.type == ContactType::edge_edge) {
        const auto ends = [](const CollisionMesh& mesh, int edge, const Pose& pose, Vec3 out[2]) {
            out[0] = pose * mesh.vertices[mesh.edges[edge].p0];
            out[1] = pose * mesh.vertices[mesh.edges[edge].p1];
        };
        Vec3 a0[2], a1[2], b0[2], b1[2];
        ends(mesh_a, contact.feature_a, sweep_a.begin, a0);
        ends(mesh_a, contact.feature_a, sweep_a.end, a1);
        ends(mesh_b, contact.feature_b, sweep_b.begin, b0);
        ends(mesh_b, contact.feature_b, sweep_b.end, b1);
        return edge_edge_toi(a0, a1, b0, b1, options);
    }
    const bool vertex_on_a = contact.type == ContactType::vertex_patch;
    const CollisionMesh& mesh_v = vertex_on_a ? mesh_a : mesh_b;
    const CollisionMesh& mesh_p = vertex_on_a ? mesh_b : mesh_a;
    const Sweep& sweep_v = vertex_on_a ? sweep_a : sweep_b;
    const Sweep& sweep_p = vertex_on_a ? sweep_b : sweep_a;
    const Vec3& x = mesh_v.vertices[vertex_on_a ? contact.feature_a : contact.feature_b];
    const int patch = vertex_on_a ? contact.feature_b : contact.feature_a;
    const Corners begin(mesh_p, patch, sweep_p.begin), end(mesh_p, patch, sweep_p.end);
    return vertex_polygon_toi(sweep_v.begin * x, sweep_v.end * x, begin.data(), end.data(), begin.count(), options);
}

Vec12 distance_gradient(const ContactGeometry& geometry, const Vec3& center_a, const Vec3& center_b) {
    const Vec3& n = geometry.normal;
    Vec12 row;
    row << (geometry.closest.point_a - center_a).cross(n), n, -(geometry.closest.point_b - center_b).cross(n), -n;
    return row;
}

double contact_energy(const ContactGeometry& geometry, const ContactRange& range, double stiffness) {
    const double compression = range.rest - geometry.distance;
    if (!(compression > 0.0)) return 0.0;
    const double energy = contact_potential(compression, range.rest - range.pole, stiffness).energy;
    if (geometry.sine_sq >= kParallelLimit) return energy;
    // Exactly parallel edges have no energy however close they are: vertex-patch pairs hold them apart.
    return geometry.sine_sq > 0.0 ? edge_mollifier(geometry.sine_sq).value * energy : 0.0;
}

ContactDerivatives contact_derivatives(
    const ContactGeometry& geometry, const ContactRange& range, double stiffness, const Vec3& center_a,
    const Vec3& center_b, bool with_hessian, bool with_curvature) {
    ContactDerivatives result;
    result.row = distance_gradient(geometry, center_a, center_b);
    const PotentialValue potential =
        contact_potential(range.rest - geometry.distance, range.rest - range.pole, stiffness);
    const bool mollified = geometry.sine_sq < kParallelLimit;
    const Mollifier mollifier = mollified ? edge_mollifier(geometry.sine_sq) : Mollifier{1.0, 0.0, 0.0};
    result.force = mollifier.value * potential.force;
    result.stiffness = mollifier.value * potential.stiffness;
    result.gradient = -result.force * result.row;
    AngleDerivatives angle;
    if (mollified) {
        angle = angle_derivatives(geometry.direction_a, geometry.direction_b);
        result.gradient += potential.energy * mollifier.first * angle.gradient;
    }
    if (!with_hessian) return result;
    result.hessian = result.stiffness * (result.row * result.row.transpose());
    if (!with_curvature) return result;
    if (result.force != 0.0) {
        result.hessian -=
            result.force *
            distance_hessian(geometry, geometry.closest.point_a - center_a, geometry.closest.point_b - center_b);
    }
    if (mollified) {
        const Mat12 cross = result.row * angle.gradient.transpose();
        result.hessian -= potential.force * mollifier.first * (cross + cross.transpose());
        result.hessian += potential.energy * (mollifier.second * (angle.gradient * angle.gradient.transpose()) +
                                              mollifier.first * angle.hessian);
    }
    return result;
}

GroundDerivatives ground_derivatives(
    double height, const Vec3& arm, const ContactRange& range, double stiffness, bool with_curvature) {
    const PotentialValue potential = contact_potential(range.rest - height, range.rest - range.pole, stiffness);
    GroundDerivatives result;
    result.force = potential.force;
    result.stiffness = potential.stiffness;
    result.row << arm.y(), -arm.x(), 0.0, 0.0, 0.0, 1.0;
    result.hessian.noalias() = (potential.stiffness * result.row) * result.row.transpose();
    if (with_curvature) result.hessian.topLeftCorner<3, 3>() -= potential.force * turn_curvature(arm, Vec3::UnitZ());
    return result;
}

}  // namespace diffsim
