#include "contact/zone.hpp"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>

#include "math/rotation.hpp"

namespace diffsim {
namespace {

template <int N>
Eigen::Matrix<double, N, N> positive_part(const Eigen::Matrix<double, N, N>& symmetric) {
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, N, N>> eigen(symmetric);
    return eigen.eigenvectors() * eigen.eigenvalues().cwiseMax(0.0).asDiagonal() * eigen.eigenvectors().transpose();
}

/// |L⁻¹ g| of one body.
double scaled_norm(const ZoneBody& body, const Vec6& gradient) {
    const Vec3 turn = gradient.head<3>();
    return std::sqrt(turn.dot(body.inverse_inertia * turn) + gradient.tail<3>().squaredNorm() / body.mass);
}

/// Adds up the contacts' derivatives along the bodies' twists.
class Assembler {
public:
    Assembler(const Zone& zone, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system)
        : m_zone(zone), m_curvature(curvature), m_derivatives(derivatives), m_system(system) {}

    void add(const ZonePoint& point, const ActiveContact& active) {
        const ZoneContact& contact = m_zone.contacts[active.index];
        const Vec3& center_a = point.poses[contact.a].t;
        const double stiffness = contact.stiffness.value;
        if (contact.contact.with_ground()) {
            const GroundDerivatives d = ground_derivatives(
                active.geometry.distance, active.geometry.closest.point_a - center_a, contact.range, stiffness,
                m_curvature != Curvature::dropped);
            add_body(contact.a, d.row, -d.force * d.row, d.force, d.stiffness, d.hessian);
            return;
        }
        const ContactDerivatives d = contact_derivatives(
            active.geometry, contact.range, stiffness, center_a, point.poses[contact.b].t, m_system != nullptr,
            m_curvature != Curvature::dropped);
        const bool yields_a = contact.a < m_zone.dynamic_count, yields_b = contact.b < m_zone.dynamic_count;
        if (yields_a && yields_b && m_curvature == Curvature::projected) {
            const Mat12 hessian = positive_part<12>(d.hessian);
            add_pair(contact, d, hessian);
            return;
        }
        if (yields_a && yields_b) {
            add_pair(contact, d, d.hessian);
        } else if (yields_a) {
            add_body(
                contact.a, d.row.head<6>(), d.gradient.head<6>(), d.force, d.stiffness,
                d.hessian.topLeftCorner<6, 6>());
        } else {
            add_body(
                contact.b, d.row.tail<6>(), d.gradient.tail<6>(), d.force, d.stiffness,
                d.hessian.bottomRightCorner<6, 6>());
        }
    }

private:
    void add_gradient(int body, const Vec6& row, const Vec6& gradient, double force, double stiffness) {
        m_derivatives.gradient[body] += gradient;
        const double scale = scaled_norm(m_zone.bodies[body], row);
        m_derivatives.largest_force = std::max(m_derivatives.largest_force, force * scale);
        m_derivatives.largest_stiffness = std::max(m_derivatives.largest_stiffness, stiffness * scale);
    }

    void add_body(
        int body, const Vec6& row, const Vec6& gradient, double force, double stiffness, const Mat6& hessian) {
        add_gradient(body, row, gradient, force, stiffness);
        if (m_system == nullptr) return;
        m_system->diagonal(body) += m_curvature == Curvature::projected ? positive_part<6>(hessian) : hessian;
    }

    void add_pair(const ZoneContact& contact, const ContactDerivatives& d, const Mat12& hessian) {
        add_gradient(contact.a, d.row.head<6>(), d.gradient.head<6>(), d.force, d.stiffness);
        add_gradient(contact.b, d.row.tail<6>(), d.gradient.tail<6>(), d.force, d.stiffness);
        if (m_system == nullptr) return;
        m_system->diagonal(contact.a) += hessian.topLeftCorner<6, 6>();
        m_system->diagonal(contact.b) += hessian.bottomRightCorner<6, 6>();
        if (contact.a < contact.b)
            m_system->off_diagonal(contact.pair) += hessian.topRightCorner<6, 6>();
        else
            m_system->off_diagonal(contact.pair) += hessian.bottomLeftCorner<6, 6>();
    }

    const Zone& m_zone;
    Curvature m_curvature;
    ZoneDerivatives& m_derivatives;
    BlockSystem* m_system;
};

}  // namespace

Pose pose_at(const ZoneBody& body, const Vec6& y) {
    if (y.isZero(0.0)) return body.start;
    return {exp_rotation(y.head<3>()) * body.start.R, body.start.t + y.tail<3>()};
}

void rescue_contacts(Zone& zone) {
    for (ZoneContact& contact : zone.contacts) {
        const Pose& pose_a = zone.bodies[contact.a].start;
        const Pose& pose_b = contact.contact.with_ground() ? pose_a : zone.bodies[contact.b].start;
        const double distance =
            contact_geometry(*zone.model, contact.contact, pose_a, pose_b, zone.ground_height).distance;
        contact.range = rescued_range(contact.range, distance);
    }
}

Mat6 chart_jacobian(const Vec6& y) {
    Mat6 jacobian = Mat6::Identity();
    jacobian.topLeftCorner<3, 3>() = left_jacobian(y.head<3>());
    return jacobian;
}

Mat3 chart_curvature(const Vec6& y, const Vec3& torque) {
    // The gradient is Jᵀ torque; along a turn phi = J dtheta the torque changes by (H - ½ [torque]x) phi, H symmetric.
    const Vec3 theta = y.head<3>();
    const Mat3 J = left_jacobian(theta);
    const Mat3 full = left_jacobian_transposed_derivative(theta, torque) - 0.5 * J.transpose() * skew(torque) * J;
    return 0.5 * (full + full.transpose());
}

void evaluate(const Zone& zone, ZonePoint& point) {
    const int count = zone.body_count();
    point.poses.resize(static_cast<std::size_t>(count));
    double inertial = 0.0;
    for (int i = 0; i < count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        point.poses[i] = pose_at(body, point.y[i]);
        if (i >= zone.dynamic_count) continue;
        const Vec6 error = point.y[i] - body.target;
        inertial +=
            0.5 * (error.head<3>().dot(body.inertia * error.head<3>()) + body.mass * error.tail<3>().squaredNorm());
    }
    point.distances.resize(zone.contacts.size());
    point.active.clear();
    point.contact_energy = 0.0;
    static const Pose kNoPose;
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        if (contact.contact.with_ground()) {
            const Pose& pose = point.poses[contact.a];
            const Vec3& x = zone.mesh(contact.a).vertices[contact.contact.feature_a];
            const double height = pose.R.row(2).dot(x) + pose.t.z() - zone.ground_height;
            point.distances[k] = height;
            if (!(height < contact.range.rest)) continue;
        }
        const Pose& pose_b = contact.contact.with_ground() ? kNoPose : point.poses[contact.b];
        const ContactGeometry geometry =
            contact_geometry(*zone.model, contact.contact, point.poses[contact.a], pose_b, zone.ground_height);
        point.distances[k] = geometry.distance;
        // Exactly parallel edges carry no energy and have no closest points: vertex-patch pairs act there.
        if (!(geometry.distance < contact.range.rest) || geometry.sine_sq == 0.0) continue;
        point.contact_energy += contact_energy(geometry, contact.range, contact.stiffness.value);
        point.active.push_back({static_cast<int>(k), geometry});
    }
    point.energy = inertial + point.contact_energy;
}

void differentiate(
    const Zone& zone, const ZonePoint& point, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system) {
    const int count = zone.dynamic_count;
    derivatives.gradient.assign(static_cast<std::size_t>(count), Vec6::Zero());
    derivatives.torque.resize(static_cast<std::size_t>(count));
    derivatives.largest_force = derivatives.largest_stiffness = 0.0;
    if (curvature == Curvature::none) system = nullptr;
    if (system != nullptr) system->set_zero();
    Assembler assembler(zone, curvature, derivatives, system);
    for (const ActiveContact& active : point.active) assembler.add(point, active);

    // From twists to coordinates. Bodies that have not turned and carry no torque need no change of chart.
    for (int i = 0; i < count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        const Vec6 error = point.y[i] - body.target;
        Vec6& gradient = derivatives.gradient[i];
        derivatives.torque[i] = gradient.head<3>();
        const bool turned = !point.y[i].head<3>().isZero(0.0);
        if (turned) {
            const Mat3 J = left_jacobian(point.y[i].head<3>());
            gradient.head<3>() = J.transpose() * derivatives.torque[i];
            if (system != nullptr) {
                Mat6& block = system->diagonal(i);
                block.topRows<3>() = J.transpose() * block.topRows<3>().eval();
                block.leftCols<3>() = block.leftCols<3>().eval() * J;
            }
        }
        gradient.head<3>() += body.inertia * error.head<3>();
        gradient.tail<3>() += body.mass * error.tail<3>();
        if (system == nullptr) continue;
        Mat6& block = system->diagonal(i);
        if (turned && curvature != Curvature::dropped && !derivatives.torque[i].isZero(0.0)) {
            const Mat3 extra = chart_curvature(point.y[i], derivatives.torque[i]);
            block.topLeftCorner<3, 3>() += curvature == Curvature::projected ? positive_part<3>(extra) : extra;
        }
        block.topLeftCorner<3, 3>() += body.inertia;
        block.diagonal().tail<3>().array() += body.mass;
    }
    if (system == nullptr) return;
    for (int k = 0; k < static_cast<int>(zone.pairs.size()); ++k) {
        const auto [i, j] = zone.pairs[k];
        Mat6& block = system->off_diagonal(k);
        block.topRows<3>() = left_jacobian(point.y[i].head<3>()).transpose() * block.topRows<3>().eval();
        block.leftCols<3>() = block.leftCols<3>().eval() * left_jacobian(point.y[j].head<3>());
    }
}

}  // namespace diffsim
