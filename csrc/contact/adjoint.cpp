#include "contact/adjoint.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <Eigen/QR>
#include <cmath>

#include "math/rotation.hpp"

namespace diffsim {
namespace {

/// The contacts as rows of the paper's J, in the coordinates y, and their stiffness.
struct Rows {
    MatrixX J;          // m x n
    VectorX stiffness;  // m [kg]
};

/// Derivatives of an active contact; with the ground only the parts of body a are set.
ContactDerivatives derivatives_of(
    const Zone& zone, const ZonePoint& point, const ActiveContact& active, bool with_curvature) {
    const ZoneContact& contact = zone.contacts[active.index];
    const Vec3& center_a = point.poses[contact.a].t;
    if (!contact.contact.with_ground())
        return contact_derivatives(
            active.geometry, contact.range, contact.stiffness.value, center_a, point.poses[contact.b].t, true,
            with_curvature);
    const GroundDerivatives ground = ground_derivatives(
        active.geometry.distance, active.geometry.closest.point_a - center_a, contact.range, contact.stiffness.value,
        with_curvature);
    ContactDerivatives result;
    result.row.head<6>() = ground.row;
    result.gradient.head<6>() = -ground.force * ground.row;
    result.hessian.topLeftCorner<6, 6>() = ground.hessian;
    result.force = ground.force;
    result.stiffness = ground.stiffness;
    return result;
}

Rows collect_rows(const Zone& zone, const ZonePoint& point) {
    const Eigen::Index count = static_cast<Eigen::Index>(point.active.size());
    Rows rows{MatrixX::Zero(count, 6 * zone.dynamic_count), VectorX(count)};
    for (Eigen::Index k = 0; k < count; ++k) {
        const ActiveContact& active = point.active[static_cast<std::size_t>(k)];
        const ZoneContact& contact = zone.contacts[active.index];
        const ContactDerivatives d = derivatives_of(zone, point, active, false);
        rows.stiffness[k] = d.stiffness;
        if (contact.a < zone.dynamic_count)
            rows.J.block<1, 6>(k, 6 * contact.a) = d.row.head<6>().transpose() * chart_jacobian(point.y[contact.a]);
        if (contact.b >= 0 && contact.b < zone.dynamic_count)
            rows.J.block<1, 6>(k, 6 * contact.b) = d.row.tail<6>().transpose() * chart_jacobian(point.y[contact.b]);
    }
    return rows;
}

VectorX flatten(const Coordinates& y) {
    return Eigen::Map<const VectorX>(y[0].data(), 6 * static_cast<Eigen::Index>(y.size()));
}

Coordinates unflatten(const VectorX& x) {
    Coordinates y(static_cast<std::size_t>(x.size() / 6));
    for (std::size_t i = 0; i < y.size(); ++i) y[i] = x.segment<6>(6 * static_cast<Eigen::Index>(i));
    return y;
}

Mat6 mass_matrix(const ZoneBody& body) {
    Mat6 mass = Mat6::Zero();
    mass.topLeftCorner<3, 3>() = body.inertia;
    mass.diagonal().tail<3>().setConstant(body.mass);
    return mass;
}

/// [ M  Jᵀ ; J  -1/stiffness ] [z; λ] = [v; 0]   [Qiao et al. 2020, Eq. 9, its constraint rows softened]
Coordinates solve_dense(const Zone& zone, const Rows& rows, const Coordinates& upstream) {
    const Eigen::Index n = rows.J.cols(), m = rows.J.rows();
    MatrixX kkt = MatrixX::Zero(n + m, n + m);
    for (int i = 0; i < zone.dynamic_count; ++i) kkt.block<6, 6>(6 * i, 6 * i) = mass_matrix(zone.bodies[i]);
    kkt.topRightCorner(n, m) = rows.J.transpose();
    kkt.bottomLeftCorner(m, n) = rows.J;
    for (Eigen::Index k = 0; k < m; ++k) kkt(n + k, n + k) = -1.0 / rows.stiffness[k];
    VectorX rhs = VectorX::Zero(n + m);
    rhs.head(n) = flatten(upstream);
    return unflatten(kkt.partialPivLu().solve(rhs).head(n));
}

/// With B = stiffness^½ J L⁻ᵀ and Bᵀ P = Q R:  (I + Bᵀ B)⁻¹ = I - Q (I - (I + R Rᵀ)⁻¹) Qᵀ, whatever the rank of B.
Coordinates solve_qr(const Zone& zone, const Rows& rows, const Coordinates& upstream) {
    const Eigen::Index n = rows.J.cols(), m = rows.J.rows();
    std::vector<Mat6> factors;
    MatrixX Bt = rows.J.transpose() * rows.stiffness.cwiseSqrt().asDiagonal();
    VectorX v = flatten(upstream);
    for (int i = 0; i < zone.dynamic_count; ++i) {
        factors.push_back(mass_matrix(zone.bodies[i]).llt().matrixL());
        const auto L = factors.back().triangularView<Eigen::Lower>();
        L.solveInPlace(v.segment<6>(6 * i));
        if (m == 0) continue;
        auto block = Bt.middleRows<6>(6 * i);
        block = L.solve(block).eval();
    }
    if (m == 0) {
        for (int i = 0; i < zone.dynamic_count; ++i)
            factors[static_cast<std::size_t>(i)].triangularView<Eigen::Lower>().transpose().solveInPlace(
                v.segment<6>(6 * i));
        return unflatten(v);
    }
    const Eigen::ColPivHouseholderQR<MatrixX> qr(Bt);
    const Eigen::Index rank = std::min(n, m);
    const MatrixX R = qr.matrixR().topRows(rank).template triangularView<Eigen::Upper>();
    VectorX projected = (qr.householderQ().transpose() * v).head(rank);
    const MatrixX gram = MatrixX::Identity(rank, rank) + R * R.transpose();
    VectorX correction = VectorX::Zero(n);
    correction.head(rank) = projected - gram.llt().solve(projected);
    v -= qr.householderQ() * correction;
    for (int i = 0; i < zone.dynamic_count; ++i)
        factors[static_cast<std::size_t>(i)].triangularView<Eigen::Lower>().transpose().solveInPlace(
            v.segment<6>(6 * i));
    return unflatten(v);
}

/// Hard contacts: J z = 0 with reactions r, H z + Jᵀ r = v, by proximal steps r += stiffness * J z on the system that
/// gives way. Every step leaves about a compliance's part; they end when z no longer changes, since a small J z alone
/// does not mean that z is right. Returns the reactions, the last step's left out: the soft contacts carry it.
template <typename Solve>
std::vector<double> harden(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, const Solve& solve, Coordinates& z) {
    constexpr int kMaxSteps = 30;
    constexpr double kTolerance = 1e-14;  // on the change of z, relative: rounding
    std::vector<ContactDerivatives> contacts;
    for (const ActiveContact& active : point.active) contacts.push_back(derivatives_of(zone, point, active, false));
    std::vector<double> reactions(contacts.size(), 0.0);
    for (int step = 0; step < kMaxSteps; ++step) {
        std::vector<double> next = reactions;
        Coordinates rhs = upstream;
        for (std::size_t k = 0; k < contacts.size(); ++k) {
            const ZoneContact& contact = zone.contacts[point.active[k].index];
            const auto along = [&](int body, const Vec6& row) {
                return body >= 0 && body < zone.dynamic_count ? row.dot(chart_jacobian(point.y[body]) * z[body]) : 0.0;
            };
            next[k] += contacts[k].stiffness *
                       (along(contact.a, contacts[k].row.head<6>()) + along(contact.b, contacts[k].row.tail<6>()));
            const auto react = [&](int body, const Vec6& row) {
                if (body >= 0 && body < zone.dynamic_count)
                    rhs[body] -= next[k] * (chart_jacobian(point.y[body]).transpose() * row);
            };
            react(contact.a, contacts[k].row.head<6>());
            react(contact.b, contacts[k].row.tail<6>());
        }
        const Coordinates better = solve(rhs);
        double change = 0.0, size = 0.0;
        for (std::size_t i = 0; i < z.size(); ++i) {
            change = std::max(change, (better[i] - z[i]).norm());
            size = std::max(size, better[i].norm());
        }
        z = better;
        reactions = next;
        if (change <= kTolerance * size) break;
    }
    return reactions;
}

}  // namespace

ZoneAdjoint zone_adjoint(
    const Zone& zone, const ZonePoint& point, const Coordinates& upstream, AdjointMode mode, BlockSystem& system) {
    const bool exact = mode == AdjointMode::exact;
    ZoneAdjoint result;
    ZoneDerivatives derivatives;
    if (exact) {
        system.set_pattern(zone.dynamic_count, zone.pairs);
        differentiate(zone, point, Curvature::exact, derivatives, &system);
        if (!system.factorize()) {
            // Only where the forward stopped short of a minimum. The projected Hessian keeps the answer finite.
            differentiate(zone, point, Curvature::projected, derivatives, &system);
            system.factorize();
        }
    }
    const Rows rows = exact ? Rows{} : collect_rows(zone, point);
    const auto solve = [&](const Coordinates& rhs) {
        if (mode == AdjointMode::dense) return solve_dense(zone, rows, rhs);
        if (mode == AdjointMode::qr) return solve_qr(zone, rows, rhs);
        Coordinates z = rhs;
        system.solve_in_place(z);
        return z;
    };
    result.multiplier = solve(upstream);
    const std::vector<double> reactions =
        zone.hard ? harden(zone, point, upstream, solve, result.multiplier) : std::vector<double>();

    result.pose_gradient.assign(static_cast<std::size_t>(zone.body_count()), Vec6::Zero());
    result.mass_gradient.assign(static_cast<std::size_t>(zone.dynamic_count), 0.0);
    std::vector<Vec6> twist(static_cast<std::size_t>(zone.body_count()), Vec6::Zero());
    for (int i = 0; i < zone.dynamic_count; ++i) {
        twist[i] = result.multiplier[i];
        twist[i].head<3>() = left_jacobian(point.y[i].head<3>()) * result.multiplier[i].head<3>();
    }
    for (std::size_t k = 0; k < point.active.size(); ++k) {
        const ActiveContact& active = point.active[k];
        const ZoneContact& contact = zone.contacts[active.index];
        const ContactDerivatives d = derivatives_of(zone, point, active, exact);
        double along;  // of the contact's gradient along the multiplier's twists
        if (contact.contact.with_ground()) {
            result.pose_gradient[contact.a] -= d.hessian.topLeftCorner<6, 6>() * twist[contact.a];
            along = d.gradient.head<6>().dot(twist[contact.a]);
            if (zone.hard) result.pose_gradient[contact.a] -= reactions[k] * d.row.head<6>();
        } else {
            Vec12 both;
            both << twist[contact.a], twist[contact.b];
            const Vec12 gradient = d.hessian * both;
            result.pose_gradient[contact.a] -= gradient.head<6>();
            result.pose_gradient[contact.b] -= gradient.tail<6>();
            along = d.gradient.dot(both);
            if (zone.hard) {
                result.pose_gradient[contact.a] -= reactions[k] * d.row.head<6>();
                result.pose_gradient[contact.b] -= reactions[k] * d.row.tail<6>();
            }
        }
        if (zone.hard) continue;  // the stiffness is only how the multipliers were found
        if (contact.a < zone.dynamic_count) result.mass_gradient[contact.a] -= along * contact.stiffness.log_gradient_a;
        if (contact.b >= 0 && contact.b < zone.dynamic_count)
            result.mass_gradient[contact.b] -= along * contact.stiffness.log_gradient_b;
    }
    if (exact) {
        // A turn of the base turns the torque too: d(torque) = (H - ½ [torque]x) phi with H symmetric.
        for (int i = 0; i < zone.dynamic_count; ++i)
            result.pose_gradient[i].head<3>() -= 0.5 * skew(derivatives.torque[i]) * twist[i].head<3>();
    }
    return result;
}

}  // namespace diffsim
