#include "zone/zone.hpp"

#include <Eigen/Eigenvalues>
#include <utility>

#include "fixtures.hpp"
#include "zone/chart.hpp"
#include "zone/contact_row.hpp"
#include "zone/contacts.hpp"

namespace test_zone {

using namespace diffsim;
using fixtures::dense;
using fixtures::flatten;
using fixtures::random_rotation;
using fixtures::random_vec3;
using fixtures::unflatten;

namespace {

constexpr double kStep = 1e-5;         // [rad or m]; contacts are about 0.1 m apart
constexpr double kDifferences = 1e-7;  // relative to the largest entries, which the stiffest contacts set
constexpr double kThickness = 0.5;     // [m]; large, so that about a hundred contacts act at once

/// Three free bodies, a fixed and a driven one, near each other above the ground.
Model near_bodies() {
    Model model;
    model.thickness = kThickness;
    model.ground = {true, -1.2, 0.5 * kThickness};
    model.bodies.push_back(fixtures::body(fixtures::box(Vec3(0.5, 0.4, 0.3)), 0.5 * kThickness));
    model.bodies.push_back(fixtures::body(fixtures::tetrahedron(0.5), 0.5 * kThickness));
    model.bodies.push_back(fixtures::body(fixtures::box(Vec3(0.3, 0.6, 0.4)), 0.5 * kThickness));
    model.bodies.push_back(fixtures::body(fixtures::box(Vec3(0.4, 0.4, 0.4)), 0.5 * kThickness, BodyKind::static_));
    model.bodies.push_back(fixtures::body(fixtures::tetrahedron(0.4), 0.5 * kThickness, BodyKind::kinematic));
    return model;
}

void add_contact(Zone& zone, int a, int b, ContactType type, int feature_a, int feature_b) {
    ContactSet& set = zone.contacts;
    if (set.append({a, b, type, feature_a, feature_b}, {a, -1}, {b, -1}, false)) {
        set.laws.push_back({contact_range(kThickness, kThickness), {10.0, 0.0, 0.0}});
        for (int k = 0; k < static_cast<int>(set.blocks.size()); ++k)
            if (set.blocks[k] == std::pair(std::min(a, b), std::max(a, b))) set.pairs.back().block = k;
    }
    list_feature_vertices(zone, set[set.size() - 1]);
}

/// Every pair of features of bodies of which one yields. The order of a and b alternates.
void add_all_contacts(Zone& zone) {
    const int count = zone.body_count(), dynamic = zone.dynamic_count;
    for (int i = 0; i < dynamic; ++i)
        for (int j = i + 1; j < dynamic; ++j) zone.contacts.blocks.emplace_back(i, j);
    for (int i = 0; i < dynamic; ++i) {
        for (int v : zone.mesh(i).active_vertices) add_contact(zone, i, kGround, ContactType::vertex_patch, v, -1);
        for (int j = i + 1; j < count; ++j) {
            const bool swap = (i + j) % 2 == 0;
            const int a = swap ? j : i, b = swap ? i : j;
            for (int v : zone.mesh(a).active_vertices)
                for (int p = 0; p < static_cast<int>(zone.mesh(b).patches.size()); ++p)
                    add_contact(zone, a, b, ContactType::vertex_patch, v, p);
            for (int v : zone.mesh(b).active_vertices)
                for (int p = 0; p < static_cast<int>(zone.mesh(a).patches.size()); ++p)
                    add_contact(zone, a, b, ContactType::patch_vertex, p, v);
            for (int ea = 0; ea < static_cast<int>(zone.mesh(a).edges.size()); ++ea)
                for (int eb = 0; eb < static_cast<int>(zone.mesh(b).edges.size()); ++eb)
                    add_contact(zone, a, b, ContactType::edge_edge, ea, eb);
        }
    }
}

/// A zone at coordinates turned by up to 2 rad, where its bodies are near each other: the start lies that much before.
Zone random_zone(const Model& model, check::Random& random, Coordinates& y) {
    static const std::vector<ClothParameters> no_cloth;
    Zone zone;
    make_zone(zone, model, no_cloth, kDefaultCompliance, Vec3::Zero());
    zone.dynamic_count = 3;
    y = Coordinates();
    const Vec3 places[5] = {{-0.8, 0, -0.4}, {0.8, 0.1, -0.3}, {0, 0, 0.95}, {0, 1.35, 0}, {0, -1.2, 0}};
    for (int i = 0; i < 5; ++i) {
        Vec6 coordinates;
        coordinates << random.uniform(0.2, 2.0) * fixtures::random_direction(random), random_vec3(random, 0.5);
        if (i == 3) coordinates.setZero();
        y.bodies.push_back(coordinates);
        const Mat3 R = random_rotation(random);
        const Pose start{
            exp_rotation(coordinates.head<3>()).transpose() * R,
            places[i] + random_vec3(random, 0.1) - coordinates.tail<3>()};
        const double mass = random.uniform(1.0, 3.0);
        ZoneBody body =
            fixtures::zone_body(i, start, i < 3 ? mass : kInfinity, 0.2 * fixtures::random_inertia(random, 3.0));
        body.target = i < 3 ? Vec6(coordinates + 0.3 * random.vector(6)) : coordinates;
        zone.bodies.push_back(body);
    }
    add_all_contacts(zone);
    return zone;
}

/// The coordinates of the bodies that yield, as one vector.
ZonePoint point_at(const Zone& zone, const Coordinates& y, const VectorX& change) {
    ZonePoint point;
    point.y = y;
    for (int i = 0; i < zone.dynamic_count; ++i) point.y.bodies[i] += change.segment<6>(6 * i);
    evaluate(zone, point);
    return point;
}

bool same_contacts(const ZonePoint& a, const ZonePoint& b) {
    if (a.active.size() != b.active.size()) return false;
    for (std::size_t k = 0; k < a.active.size(); ++k)
        if (a.active[k].index != b.active[k].index ||
            a.active[k].geometry.closest.feature_code != b.active[k].geometry.closest.feature_code ||
            (a.active[k].geometry.sine_sq < kParallelLimit) != (b.active[k].geometry.sine_sq < kParallelLimit))
            return false;
    return true;
}

bool is_stable(const Zone& zone, const Coordinates& y) {
    const ZonePoint here = point_at(zone, y, VectorX::Zero(18));
    for (const ActiveContact& active : here.active)
        if (active.geometry.distance < 0.15 * kThickness) return false;  // near the pole, differences have no hold
    if (here.energy == kInfinity) return false;
    for (int i = 0; i < 18; ++i)
        for (const double by : {2.0 * kStep, -2.0 * kStep})
            if (!same_contacts(here, point_at(zone, y, by * VectorX::Unit(18, i)))) return false;
    return true;
}

struct Derivatives {
    VectorX gradient;
    MatrixX hessian;
};

Derivatives derivatives_at(const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut = kNothingCut) {
    ZoneDerivatives derivatives;
    BlockSystem system;
    system.set_pattern(base_pattern(zone));
    differentiate(zone, point, curvature, derivatives, &system, cut);
    return {flatten(derivatives.gradient), curvature == Curvature::none ? MatrixX() : dense(system)};
}

MatrixX mass_matrix(const Zone& zone) {
    MatrixX M = MatrixX::Zero(6 * zone.dynamic_count, 6 * zone.dynamic_count);
    for (int i = 0; i < zone.dynamic_count; ++i) {
        M.block<3, 3>(6 * i, 6 * i) = zone.bodies[i].inertia;
        M.block<3, 3>(6 * i + 3, 6 * i + 3) = zone.bodies[i].mass * Mat3::Identity();
    }
    return M;
}

MatrixX smooth_hessian(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut) {
    ZoneDerivatives derivatives;
    BlockSystem system;
    system.set_pattern(base_pattern(zone));
    differentiate_smooth(zone, point, pushing, cut, derivatives, system);
    return dense(system);
}

double lowest_eigenvalue(const MatrixX& symmetric) {
    return Eigen::SelfAdjointEigenSolver<MatrixX>(symmetric, Eigen::EigenvaluesOnly).eigenvalues()[0];
}

template <typename Test>
void for_stable_zones(int count, const Test& test) {
    const Model model = near_bodies();
    check::Random random(1);
    int cases_hit = 0;
    for (int k = 0; k < 1000 && cases_hit < count; ++k) {
        NOTE(k);
        Coordinates y;
        const Zone zone = random_zone(model, random, y);
        const ZonePoint point = point_at(zone, y, VectorX::Zero(18));
        int ground = 0;
        for (const ActiveContact& active : point.active)
            ground += zone.contacts[active.index].contact.with_ground() ? 1 : 0;
        if (ground == 0 || point.active.size() < 30 || !is_stable(zone, y)) continue;
        test(zone, y, point);
        ++cases_hit;
    }
    CHECK(cases_hit == count);
}

}  // namespace

TEST(zone_gradient_and_hessian_agree_with_differences) {
    for_stable_zones(4, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        const Derivatives d = derivatives_at(zone, point, Curvature::full);
        CHECK(point.contact_energy > 0.0);
        CHECK(d.gradient.cwiseAbs().minCoeff() > 0.0);
        const auto energy = [&](const VectorX& x) { return point_at(zone, y, x).energy; };
        const auto gradient = [&](const VectorX& x) {
            return derivatives_at(zone, point_at(zone, y, x), Curvature::none).gradient;
        };
        const VectorX zero = VectorX::Zero(18);
        CHECK(derivatives_at(zone, point, Curvature::none).gradient == d.gradient);
        CHECK_NEAR(d.gradient, fixtures::numeric_gradient(energy, zero, kStep), kDifferences * d.gradient.norm());
        CHECK_NEAR(d.hessian, fixtures::numeric_jacobian(gradient, zero, kStep), kDifferences * d.hessian.norm());
        CHECK_NEAR(d.hessian, d.hessian.transpose(), 1e-12 * d.hessian.norm());
        CHECK(d.hessian.block(0, 6, 6, 12).norm() + d.hessian.block(6, 12, 6, 6).norm() > 0.0);
    });
}

TEST(projected_hessian_is_never_indefinite) {
    int indefinite = 0;
    for_stable_zones(4, [&](const Zone& zone, const Coordinates&, const ZonePoint& point) {
        const MatrixX M = mass_matrix(zone);
        const Derivatives exact = derivatives_at(zone, point, Curvature::full);
        const Derivatives projected = derivatives_at(zone, point, Curvature::full, kAllCut);
        CHECK(projected.gradient == exact.gradient);
        // The contacts' part in coordinates: projected it is semidefinite, to rounding of its largest eigenvalue.
        CHECK(lowest_eigenvalue(projected.hessian - M) >= -1e-12 * projected.hessian.norm());
        CHECK(lowest_eigenvalue(projected.hessian) > 0.0);
        indefinite += lowest_eigenvalue(exact.hessian - M) < -1e-3 ? 1 : 0;
    });
    CHECK(indefinite >= 2);
}

TEST(dropped_curvature_leaves_mass_and_rows) {
    for_stable_zones(3, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        MatrixX expected = mass_matrix(zone);
        for (const ActiveContact& active : point.active) {
            const ZoneContact& contact = zone.contacts[active.index];
            const bool ground = contact.contact.with_ground();
            const Vec3 center_b = ground ? Vec3(Vec3::Zero()) : point.poses[contact.b].t;
            const auto d = contact_derivatives(
                active.geometry, contact.law, BodySide{point.poses[contact.a].t}, BodySide{center_b}, true, false);
            VectorX row = VectorX::Zero(18);
            if (contact.a < 3)
                row.segment<6>(6 * contact.a) = chart_jacobian(y.bodies[contact.a]).transpose() * d.row.head<6>();
            if (contact.b >= 0 && contact.b < 3)
                row.segment<6>(6 * contact.b) = chart_jacobian(y.bodies[contact.b]).transpose() * d.row.tail<6>();
            expected += d.stiffness * row * row.transpose();
        }
        const Derivatives dropped = derivatives_at(zone, point, Curvature::dropped);
        CHECK_NEAR(dropped.hessian, expected, 1e-12 * expected.norm());
        const Derivatives exact = derivatives_at(zone, point, Curvature::full);
        CHECK((dropped.hessian - exact.hessian).norm() > 1e-3 * exact.hessian.norm());
    });
}

TEST(curvature_of_contacts_with_forces_of_their_own_agrees_with_differences) {
    for_stable_zones(3, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        check::Random random(5);
        std::vector<PushingContact> pushing;
        for (const ActiveContact& active : point.active)
            if (active.geometry.sine_sq >= kParallelLimit)
                pushing.push_back({active.index, &active.geometry, random.uniform(0.5, 2.0)});
        CHECK(pushing.size() >= 20);
        // - force d(distance)/dy, the forces held fixed
        const auto gradient = [&](const VectorX& x) {
            const ZonePoint there = point_at(zone, y, x);
            const Placement at{there.y, there.poses, there.nodes};
            Coordinates sum;
            sum.assign_zero(3, 0);
            for (const PushingContact& push : pushing) {
                const ZoneContact& contact = zone.contacts[push.index];
                const ContactGeometry geometry = contact_geometry(zone, contact, there.poses, there.nodes);
                add_row(make_row(zone, contact, geometry, at, there.y, 0.0), -push.force, sum);
            }
            return flatten(sum);
        };
        const MatrixX M = mass_matrix(zone);
        const MatrixX exact = smooth_hessian(zone, point, pushing, kNothingCut) - M;
        const MatrixX projected = smooth_hessian(zone, point, pushing, kAllCut) - M;
        CHECK(exact.norm() > 1.0);
        CHECK_NEAR(exact, fixtures::numeric_jacobian(gradient, VectorX::Zero(18), kStep), kDifferences * exact.norm());
        CHECK(lowest_eigenvalue(exact) < -1e-3);
        CHECK(lowest_eigenvalue(projected) >= -1e-12 * projected.norm());
        CHECK(smooth_hessian(zone, point, {}, kNothingCut) == M);
    });
}

TEST(chart_curvature_agrees_with_differences) {
    check::Random random(2);
    for (const double angle : {0.0, 1e-3, 0.5, 2.0}) {
        NOTE(angle);
        Vec6 y;
        y << angle * fixtures::random_direction(random), random_vec3(random);
        // A potential of the orientation: its chart Hessian is Jᵀ H J + curvature, with H at the turned pose.
        const Vec3 arm = random_vec3(random), force = random_vec3(random);
        const auto torque_at = [&](const Vec3& theta) -> Vec3 { return Vec3(exp_rotation(theta) * arm).cross(force); };
        const auto gradient = [&](const VectorX& theta) -> VectorX {
            return left_jacobian(Vec3(theta)).transpose() * torque_at(theta);
        };
        const Vec3 r = exp_rotation(y.head<3>()) * arm;
        Mat3 twist_hessian = 0.5 * (r * force.transpose() + force * r.transpose());
        twist_hessian.diagonal().array() -= force.dot(r);
        const Mat3 J = left_jacobian(y.head<3>());
        const Mat3 curvature = chart_curvature(y, torque_at(y.head<3>()));
        CHECK_NEAR(
            J.transpose() * twist_hessian * J + curvature,
            fixtures::numeric_jacobian(gradient, VectorX(y.head<3>()), 1e-4), 1e-9);
        if (angle > 0.1) CHECK(curvature.norm() > 1e-3);
    }
}

TEST(energy_without_contact_is_inertial) {
    const Model model = near_bodies();
    check::Random random(3);
    Coordinates y;
    Zone zone = random_zone(model, random, y);
    zone.contacts.clear();
    const ZonePoint point = point_at(zone, y, VectorX::Zero(18));
    VectorX error(18);
    for (int i = 0; i < 3; ++i) error.segment<6>(6 * i) = y.bodies[i] - zone.bodies[i].target;
    CHECK_NEAR(point.energy, 0.5 * error.dot(mass_matrix(zone) * error), 1e-13 * point.energy);
    CHECK(point.contact_energy == 0.0);
    CHECK_NEAR(derivatives_at(zone, point, Curvature::full).gradient, mass_matrix(zone) * error, 1e-13 * point.energy);
}

}  // namespace test_zone
