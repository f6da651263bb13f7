// Zones with cloth; those of rigid bodies alone are in test_zone.cpp.
#include <Eigen/Eigenvalues>
#include <algorithm>

#include "cloth_fixtures.hpp"
#include "zone/chart.hpp"
#include "zone/contact_row.hpp"
#include "zone/contacts.hpp"
#include "zone/sides_of.hpp"

namespace test_zone_cloth {

using namespace diffsim;
using fixtures::dense;
using fixtures::flatten;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr double kStep = 1e-5;         // [rad or m]; contacts are about 0.1 m apart
constexpr double kDifferences = 2e-7;  // relative to the largest entries, which the stiffest contacts set
constexpr double kThickness = 0.4;     // [m]; large, so that about a hundred contacts act at once
constexpr double kDt = 0.1;            // [s]; makes dt² times the cloth's stiffness about its mass

/// A free and a fixed body, two cloths and the ground.
struct Room {
    Model model;
    std::vector<ClothParameters> materials = {{0.9, 60.0, 20.0, 0.05, 0.03}, {0.6, 90.0, 30.0, 0.02, 0.0}};

    Room() {
        model.thickness = kThickness;
        model.ground = {true, -0.45, 0.5 * kThickness};
        model.bodies.push_back(fixtures::body(fixtures::box(Vec3(0.4, 0.5, 0.3)), 0.5 * kThickness));
        model.bodies.push_back(fixtures::body(fixtures::tetrahedron(0.3), 0.5 * kThickness, BodyKind::static_));
        model.cloths.push_back(fixtures::cloth(fixtures::grid(3, 2, 0.45), 0.5 * kThickness));
        model.cloths.push_back(fixtures::cloth(fixtures::hexagon(0.5), 0.5 * kThickness));
        model.cloths[0].pinned[0] = model.cloths[0].pinned[5] = 1;
        model.cloths[1].first_node = model.cloths[0].node_count();
    }
};

struct Case {
    Zone zone;
    Coordinates y;
};

/// At y the first sheet lies on the body, rolled up, the second hangs beside both down to the ground.
Case random_case(const Room& room, check::Random& random) {
    Case c;
    Zone& zone = c.zone;
    make_zone(zone, room.model, room.materials, 0.01, Vec3::Zero());
    Vec6 turned;
    turned << random.uniform(0.2, 2.0) * fixtures::random_direction(random), random_vec3(random, 0.3);
    const Mat3 R = exp_rotation(random_vec3(random, 0.2));
    zone.bodies.push_back(
        fixtures::zone_body(
            0, {exp_rotation(turned.head<3>()).transpose() * R, random_vec3(random, 0.1) - turned.tail<3>()}, 2.0,
            0.2 * fixtures::random_inertia(random, 3.0)));
    zone.bodies[0].target = turned + 0.3 * random.vector(6);
    c.y.bodies.push_back(turned);
    zone.dynamic_count = 1;
    const Mat3 lying = exp_rotation(random_vec3(random, 0.3));
    const Mat3 hanging = exp_rotation(random_vec3(random, 0.2)) * exp_rotation(Vec3(0.0, 0.5 * fixtures::kPi, 0.0));
    const std::vector<Vec3> roll = fixtures::rolled(room.model.cloths[0].rest, 0.22, 0.1);
    const std::vector<Vec3> at[2] = {
        fixtures::moved(fixtures::shaken(roll, random, 0.05), lying, lying * Vec3(0, -0.45, 0.0) + Vec3(0, 0, 0.8)),
        fixtures::moved(fixtures::shaken(room.model.cloths[1].rest, random, 0.05), hanging, Vec3(0.62, 0.1, 0.3))};
    for (int i = 0; i < 2; ++i) {
        std::vector<Vec3> start;
        for (const Vec3& x : at[i]) {
            c.y.nodes.push_back(random_vec3(random, 0.05));
            start.push_back(x - c.y.nodes.back());
        }
        fixtures::add_zone_cloth(zone, i, start, room.materials[static_cast<std::size_t>(i)], kDt);
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        ZoneNode& node = zone.nodes[i];
        node.target = node.pinned ? c.y.nodes[i] : Vec3(c.y.nodes[i] + random_vec3(random, 0.3));
    }
    const PassiveBodies passive =
        fixtures::passive_bodies(room.model, {{1, {random_rotation(random), Vec3(0.3, 0.95, 0.2)}, Vec6::Zero()}});
    Coordinates begin = c.y, end = c.y;
    ContactCoverage coverage;
    collect_contacts(zone, passive, begin, end, coverage);
    c.y = end;
    for (ContactLaw& law : zone.contacts.laws) law.stiffness = {10.0, 0.0, 0.0};
    return c;
}

/// Where the numbers of the free coordinates stand among all.
std::vector<int> free_rows(const Zone& zone) {
    std::vector<int> rows;
    for (int i = 0; i < 6 * zone.dynamic_count; ++i) rows.push_back(i);
    for (int i = 0; i < zone.node_count(); ++i)
        for (int k = 0; k < 3 && !zone.nodes[i].pinned; ++k) rows.push_back(6 * zone.dynamic_count + 3 * i + k);
    return rows;
}

ZonePoint point_at(const Zone& zone, const Coordinates& y, const VectorX& change) {
    ZonePoint point;
    point.y = y;
    const std::vector<int> rows = free_rows(zone);
    for (std::size_t k = 0; k < rows.size(); ++k) {
        const int row = rows[k], first_node = 6 * zone.dynamic_count;
        const double by = change[static_cast<Eigen::Index>(k)];
        if (row < first_node)
            point.y.bodies[static_cast<std::size_t>(row / 6)][row % 6] += by;
        else
            point.y.nodes[static_cast<std::size_t>((row - first_node) / 3)][(row - first_node) % 3] += by;
    }
    evaluate(zone, point);
    return point;
}

bool same_contacts(const ZonePoint& a, const ZonePoint& b) {
    const auto same = [](const ActiveContact& one, const ActiveContact& two) {
        return one.index == two.index && one.geometry.closest.feature_code == two.geometry.closest.feature_code &&
               (one.geometry.sine_sq < kParallelLimit) == (two.geometry.sine_sq < kParallelLimit);
    };
    return std::equal(a.active.begin(), a.active.end(), b.active.begin(), b.active.end(), same);
}

bool is_stable(const Zone& zone, const Coordinates& y) {
    const Eigen::Index size = static_cast<Eigen::Index>(free_rows(zone).size());
    const ZonePoint here = point_at(zone, y, VectorX::Zero(size));
    if (here.energy == kInfinity) return false;
    for (const ActiveContact& active : here.active) {
        const ContactRange& range = zone.contacts.law(active.index).range;
        if (active.geometry.distance < range.pole + 0.15 * (range.rest - range.pole)) return false;
    }
    for (Eigen::Index i = 0; i < size; ++i)
        for (const double by : {2.0 * kStep, -2.0 * kStep})
            if (!same_contacts(here, point_at(zone, y, by * VectorX::Unit(size, i)))) return false;
    return true;
}

struct Derivatives {
    VectorX gradient;
    MatrixX hessian;
};

/// Of the free coordinates; checks what stands at the others.
Derivatives derivatives_at(const Zone& zone, const ZonePoint& point, Curvature curvature, CutShare cut = kNothingCut) {
    ZoneDerivatives derivatives;
    BlockSystem system;
    system.set_pattern(base_pattern(zone));
    differentiate(zone, point, curvature, derivatives, &system, cut);
    const VectorX gradient = flatten(derivatives.gradient);
    const std::vector<int> rows = free_rows(zone);
    Derivatives result{gradient(rows), {}};
    CHECK(gradient.norm() == result.gradient.norm());  // nothing at pinned nodes
    if (curvature == Curvature::none) return result;
    const MatrixX hessian = dense(system);
    result.hessian = hessian(rows, rows);
    MatrixX rest = hessian;
    for (int r : rows)
        for (int c : rows) rest(r, c) = r == c ? 1.0 : 0.0;
    CHECK((rest - MatrixX::Identity(rest.rows(), rest.cols())).isZero(0.0));
    return result;
}

VectorX zero_change(const Zone& zone) { return VectorX::Zero(static_cast<Eigen::Index>(free_rows(zone).size())); }

MatrixX mass_matrix(const Zone& zone) {
    MatrixX M = MatrixX::Zero(6 + 3 * zone.node_count(), 6 + 3 * zone.node_count());
    M.topLeftCorner<3, 3>() = zone.bodies[0].inertia;
    M.block<3, 3>(3, 3) = zone.bodies[0].mass * Mat3::Identity();
    for (int i = 0; i < zone.node_count(); ++i)
        M.block<3, 3>(6 + 3 * i, 6 + 3 * i) = zone.nodes[i].mass * Mat3::Identity();
    const std::vector<int> rows = free_rows(zone);
    return M(rows, rows);
}

double lowest_eigenvalue(const MatrixX& symmetric) {
    return Eigen::SelfAdjointEigenSolver<MatrixX>(symmetric, Eigen::EigenvaluesOnly).eigenvalues()[0];
}

/// How many active contacts of each kind: a body and a cloth, a fixed body and a cloth, cloth and the
/// ground, two cloths, one with itself.
std::array<int, 5> count_kinds(const Zone& zone, const ZonePoint& point) {
    std::array<int, 5> counts = {};
    for (const ActiveContact& active : point.active) {
        const ZoneContact& c = zone.contacts[active.index];
        if (c.cloth_a < 0 && c.cloth_b < 0) continue;
        const std::size_t kind = c.contact.with_ground()                    ? 2
                                 : c.cloth_a < 0                            ? (zone.yields(c.a) ? 0 : 1)
                                 : c.contact.object_a != c.contact.object_b ? 3
                                                                            : 4;
        ++counts[kind];
    }
    return counts;
}

template <typename Test>
void for_stable_zones(int count, const Test& test) {
    const Room room;
    check::Random random(1);
    int cases_hit = 0;
    std::array<int, 5> kinds = {};
    for (int k = 0; k < 3000 && cases_hit < count; ++k) {
        NOTE(k);
        const Case c = random_case(room, random);
        const ZonePoint point = point_at(c.zone, c.y, zero_change(c.zone));
        const std::array<int, 5> counts = count_kinds(c.zone, point);
        if (counts[0] == 0 || counts[3] == 0 || point.active.size() < 30 || !is_stable(c.zone, c.y)) continue;
        for (std::size_t i = 0; i < counts.size(); ++i) kinds[i] += counts[i];
        test(c.zone, c.y, point);
        ++cases_hit;
    }
    CHECK(cases_hit == count);
    for (std::size_t i = 0; i < kinds.size(); ++i) {
        NOTE(i);
        CHECK(kinds[i] >= 1);
    }
}

}  // namespace

TEST(gradient_and_hessian_of_a_zone_with_cloth_agree_with_differences) {
    for_stable_zones(2, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        const Derivatives d = derivatives_at(zone, point, Curvature::full);
        CHECK(point.contact_energy > 0.0);
        CHECK(point.elastic_energy > 0.0);
        CHECK(d.gradient.cwiseAbs().minCoeff() > 0.0);
        const auto energy = [&](const VectorX& x) { return point_at(zone, y, x).energy; };
        const auto gradient = [&](const VectorX& x) {
            return derivatives_at(zone, point_at(zone, y, x), Curvature::none).gradient;
        };
        CHECK(derivatives_at(zone, point, Curvature::none).gradient == d.gradient);
        CHECK_NEAR(
            d.gradient, fixtures::numeric_gradient(energy, zero_change(zone), kStep), kDifferences * d.gradient.norm());
        CHECK_NEAR(
            d.hessian, fixtures::numeric_jacobian(gradient, zero_change(zone), kStep), kDifferences * d.hessian.norm());
        CHECK_NEAR(d.hessian, d.hessian.transpose(), 1e-12 * d.hessian.norm());
        CHECK(d.hessian.topRightCorner(6, d.hessian.cols() - 6).norm() > 0.0);
    });
}

TEST(projected_hessian_of_a_zone_with_cloth_is_never_indefinite) {
    int indefinite = 0;
    for_stable_zones(3, [&](const Zone& zone, const Coordinates&, const ZonePoint& point) {
        const MatrixX M = mass_matrix(zone);
        const Derivatives exact = derivatives_at(zone, point, Curvature::full);
        const Derivatives projected = derivatives_at(zone, point, Curvature::full, kAllCut);
        const Derivatives between = derivatives_at(zone, point, Curvature::full, 0.5);
        CHECK(projected.gradient == exact.gradient);
        const MatrixX mean = 0.5 * (exact.hessian + projected.hessian);
        CHECK_NEAR(between.hessian, mean, 1e-12 * mean.norm());
        CHECK(lowest_eigenvalue(projected.hessian - M) >= -1e-12 * projected.hessian.norm());
        CHECK(lowest_eigenvalue(projected.hessian) > 0.0);
        indefinite += lowest_eigenvalue(exact.hessian - M) < -1e-3 ? 1 : 0;
    });
    CHECK(indefinite >= 2);
}

TEST(dropped_curvature_leaves_mass_elasticity_and_rows) {
    for_stable_zones(2, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        Zone loose = zone;
        loose.contacts.clear();
        const std::vector<int> rows = free_rows(zone);
        MatrixX expected = derivatives_at(loose, point_at(loose, y, zero_change(loose)), Curvature::full).hessian;
        const MatrixX without_contact = expected;
        for (const ActiveContact& active : point.active) {
            const ZoneContact& contact = zone.contacts[active.index];
            VectorX row = VectorX::Zero(6 + 3 * zone.node_count());
            const auto add_body = [&](int body, const Vec3& at, const Vec3& normal) {
                if (!zone.yields(body)) return;
                Vec6 twist;
                twist << (at - point.poses[static_cast<std::size_t>(body)].t).cross(normal), normal;
                row.head<6>() += chart_jacobian(y.bodies[0]).transpose() * twist;
            };
            const auto add_cloth = [&](const SideOfCloth& side, const ClosestPoint& closest, const Vec3& normal) {
                const Surface surface = side.surface(point.poses, point.nodes);
                const Vec3 weights = cloth_side(closest, normal, side.feature(), surface).weights;
                const std::array<int, 3> nodes = side.nodes();
                for (int k = 0; k < 3; ++k)
                    if (nodes[static_cast<std::size_t>(k)] >= 0)
                        row.segment<3>(6 + 3 * nodes[static_cast<std::size_t>(k)]) += weights[k] * normal;
            };
            const auto add = [&](const auto& side, const ClosestPoint& closest, const Vec3& normal) {
                using Side = std::decay_t<decltype(side)>;
                if constexpr (std::is_same_v<Side, SideOfBody>) add_body(side.body(), closest.point, normal);
                if constexpr (std::is_same_v<Side, SideOfCloth>) add_cloth(side, closest, normal);
            };
            const ContactGeometry& g = active.geometry;
            with_sides(zone, contact, [&](const auto& a, const auto& b) {
                add(a, g.closest.a, g.normal);
                add(b, g.closest.b, -g.normal);
            });
            double stiffness = normal_force(contact.law, g.distance).stiffness;
            if (g.sine_sq < kParallelLimit) stiffness *= edge_mollifier(g.sine_sq).value;
            expected += stiffness * row(rows) * row(rows).transpose();
        }
        const Derivatives dropped = derivatives_at(zone, point, Curvature::dropped);
        CHECK_NEAR(dropped.hessian, expected, 1e-11 * expected.norm());
        CHECK((expected - without_contact).norm() > 1e-3 * expected.norm());
    });
}

TEST(contact_rows_are_the_gradients_of_distances) {
    for_stable_zones(2, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        constexpr double kWanted = 0.3;
        check::Random random(4);
        const Placement at{y, point.poses, point.nodes};
        Coordinates elsewhere = y;
        elsewhere.bodies[0] += random.vector(6);
        for (int i = 0; i < zone.node_count(); ++i)
            if (!zone.nodes[i].pinned) elsewhere.nodes[i] += random_vec3(random);
        const VectorX direction = random.vector(zero_change(zone).size());
        const std::vector<int> free = free_rows(zone);
        VectorX all = VectorX::Zero(6 + 3 * zone.node_count());
        for (std::size_t k = 0; k < free.size(); ++k) all[free[k]] = direction[static_cast<Eigen::Index>(k)];
        const VectorX shift = flatten(elsewhere).tail(all.size() - 6) - flatten(y).tail(all.size() - 6);
        const ZonePoint above = point_at(zone, y, kStep * direction), below = point_at(zone, y, -kStep * direction);
        for (const ActiveContact& active : point.active) {
            const ZoneContact& contact = zone.contacts[active.index];
            if (active.geometry.sine_sq < kParallelLimit) continue;
            const ContactRow row = make_row(zone, contact, active.geometry, at, y, kWanted);
            const auto along = [&](const Vec6& twist, const VectorX& nodes) {
                double sum = row.a == 0 ? row.row_a().dot(twist) : row.b == 0 ? row.row_b().dot(twist) : 0.0;
                for (std::size_t k = 0; k < row.nodes.size(); ++k)
                    sum += row.node_rows[k].dot(nodes.segment<3>(3 * row.nodes[k]));
                return sum;
            };
            const double numeric = (above.distances[active.index] - below.distances[active.index]) / (2.0 * kStep);
            CHECK_NEAR(along(all.head<6>(), all.tail(all.size() - 6)), numeric, 1e-6);
            CHECK_NEAR(row.missing, kWanted - active.geometry.distance, 1e-14);
            // Counted from elsewhere, what p makes up for has grown by the way from there.
            const ContactRow from = make_row(zone, contact, active.geometry, at, elsewhere, kWanted);
            const Vec6 back = y.bodies[0] - elsewhere.bodies[0];
            CHECK_NEAR(from.missing, row.missing + along(back, -shift), 1e-13);
        }
    });
}

TEST(curvature_of_contacts_of_cloth_with_forces_of_their_own_agrees_with_differences) {
    for_stable_zones(2, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        check::Random random(5);
        std::vector<PushingContact> pushing;
        std::vector<int> contacts;
        for (const ActiveContact& active : point.active) {
            if (active.geometry.sine_sq < kParallelLimit) continue;
            pushing.push_back({active.index, &active.geometry, random.uniform(0.5, 2.0)});
            contacts.push_back(active.index);
        }
        CHECK(pushing.size() >= 20);
        const std::vector<int> rows = free_rows(zone);
        const auto smooth = [&](const std::vector<PushingContact>& with, CutShare cut) -> MatrixX {
            ZoneDerivatives derivatives;
            BlockSystem system;
            system.set_pattern(base_pattern(zone));
            ensure_pattern(zone, contacts, system);
            differentiate_smooth(zone, point, with, cut, derivatives, system);
            return dense(system)(rows, rows);
        };
        // - force d(distance)/dy, the forces held fixed
        const auto gradient = [&](const VectorX& x) -> VectorX {
            const ZonePoint there = point_at(zone, y, x);
            const Placement at{there.y, there.poses, there.nodes};
            Coordinates sum;
            sum.assign_zero(1, zone.nodes.size());
            for (const PushingContact& push : pushing) {
                const ZoneContact& contact = zone.contacts[push.index];
                const ContactGeometry geometry = contact_geometry(zone, contact, there.poses, there.nodes);
                add_row(make_row(zone, contact, geometry, at, there.y, 0.0), -push.force, sum);
            }
            return flatten(sum)(rows);
        };
        Zone loose = zone;
        loose.contacts.clear();
        const MatrixX alone = derivatives_at(loose, point_at(loose, y, zero_change(loose)), Curvature::full).hessian;
        CHECK_NEAR(smooth({}, kNothingCut), alone, 1e-12 * alone.norm());
        const MatrixX exact = smooth(pushing, kNothingCut) - alone;
        CHECK(exact.norm() > 1.0);
        CHECK(exact.topRightCorner(6, exact.cols() - 6).norm() > 0.0);
        CHECK_NEAR(exact, fixtures::numeric_jacobian(gradient, zero_change(zone), kStep), kDifferences * exact.norm());
        const MatrixX projected = smooth(pushing, kAllCut) - smooth({}, kAllCut);
        CHECK(lowest_eigenvalue(exact) < -1e-3);
        CHECK(lowest_eigenvalue(projected) >= -1e-11 * projected.norm());
    });
}

TEST(energy_of_a_zone_has_inertia_elasticity_and_contact) {
    for_stable_zones(2, [](const Zone& zone, const Coordinates& y, const ZonePoint& point) {
        double elastic = 0.0;
        for (int i = 0; i < 2; ++i)
            elastic += kDt * kDt *
                       elastic_energy(
                           zone.cloth(i), (*zone.cloth_parameters)[i], kDt, zone.cloths[i].straining.start,
                           point.nodes.data() + zone.cloths[i].first_node);
        CHECK_NEAR(point.elastic_energy, elastic, 1e-14 * elastic);
        VectorX error(6 + 3 * zone.node_count());
        error.head<6>() = y.bodies[0] - zone.bodies[0].target;
        for (int i = 0; i < zone.node_count(); ++i) error.segment<3>(6 + 3 * i) = y.nodes[i] - zone.nodes[i].target;
        const VectorX free_error = error(free_rows(zone));
        const double inertial = 0.5 * free_error.dot(mass_matrix(zone) * free_error);
        CHECK_NEAR(point.energy, inertial + elastic + point.contact_energy, 1e-13 * point.energy);
        Zone loose = zone;
        loose.elastic = false;
        loose.contacts.clear();
        CHECK_NEAR(point_at(loose, y, zero_change(loose)).energy, inertial, 1e-13 * inertial);
    });
}

TEST(patterns_hold_what_elasticity_and_contacts_couple) {
    const Room room;
    check::Random random(3);
    const Case c = random_case(room, random);
    const BlockPattern base = base_pattern(c.zone);
    CHECK(base.body_count == 1);
    CHECK(base.node_count == c.zone.node_count());
    CHECK(base.mixed_pairs.empty());
    IndexPairs expected;
    for (const ZoneCloth& cloth : c.zone.cloths)
        for (const auto& [i, j] : room.model.cloths[cloth.id].node_pairs)
            expected.emplace_back(cloth.first_node + i, cloth.first_node + j);
    CHECK(base.node_pairs == expected);

    BlockSystem system;
    system.set_pattern(base);
    std::vector<int> contacts;
    for (int k = 0; k < static_cast<int>(c.zone.contacts.size()); k += 2) contacts.push_back(k);
    ensure_pattern(c.zone, contacts, system);
    IndexPairs mixed, nodes = expected;
    for (int k : contacts) {
        const ZoneContact& contact = c.zone.contacts[k];
        std::vector<int> touched;
        if (contact.contact.with_ground()) continue;
        visit_movers(
            c.zone, contact, [](int) {},
            [&](int node) {
                if (!c.zone.nodes[node].pinned) touched.push_back(node);
            });
        for (int i : touched) {
            if (c.zone.yields(contact.a)) mixed.emplace_back(contact.a, i);
            for (int j : touched)
                if (i < j) nodes.emplace_back(i, j);
        }
    }
    for (IndexPairs* pairs : {&mixed, &nodes}) {
        std::sort(pairs->begin(), pairs->end());
        pairs->erase(std::unique(pairs->begin(), pairs->end()), pairs->end());
    }
    CHECK(system.pattern().mixed_pairs == mixed);
    CHECK(system.pattern().node_pairs == nodes);
    CHECK(!mixed.empty());
    CHECK(nodes.size() > expected.size());
    ensure_pattern(c.zone, contacts, system);
    CHECK(system.pattern().node_pairs == nodes);

    Zone loose = c.zone;
    loose.elastic = false;
    CHECK(base_pattern(loose).node_pairs.empty());
}

}  // namespace test_zone_cloth
