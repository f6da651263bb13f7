#include "contact/impact_qp.hpp"

#include <algorithm>
#include <cmath>

#include "fixtures.hpp"

using namespace diffsim;
using fixtures::flatten;
using fixtures::random_direction;

namespace {

// The solver stops when the gradient has fallen to 1e-9 of the forces on each body.
constexpr double kOptimality = 1.01e-9;

struct Problem {
    Zone zone;
    Coordinates inertial_gradient;
    std::vector<double> mass_factor;
    std::vector<ImpactRow> rows;
    BlockSystem cloth;  // of the nodes, where there are any

    Eigen::Index size() const { return 6 * zone.dynamic_count + 3 * zone.node_count(); }
    Eigen::Index node_row(int node) const { return 6 * zone.dynamic_count + 3 * node; }
    /// The quadratic part. Pinned nodes have the unit matrix, so that they stay where they start, at zero.
    MatrixX mass() const {
        MatrixX M = MatrixX::Zero(size(), size());
        if (zone.node_count() > 0)
            M.bottomRightCorner(3 * zone.node_count(), 3 * zone.node_count()) = fixtures::dense(cloth);
        for (int i = 0; i < zone.dynamic_count; ++i) {
            const ZoneBody& body = zone.bodies[i];
            M.block<3, 3>(6 * i, 6 * i) = mass_factor[i] * body.inertia;
            M.block<3, 3>(6 * i + 3, 6 * i + 3) = mass_factor[i] * body.mass * Mat3::Identity();
        }
        return M;
    }
    VectorX row(const ImpactRow& r) const {
        VectorX full = VectorX::Zero(size());
        if (r.a >= 0) full.segment<6>(6 * r.a) = r.row_a();
        if (r.b >= 0) full.segment<6>(6 * r.b) = r.row_b();
        for (std::size_t k = 0; k < r.nodes.size(); ++k) full.segment<3>(node_row(r.nodes[k])) = r.node_rows[k];
        return full;
    }
    VectorX gradient(const VectorX& p) const {
        VectorX g = mass() * p + flatten(inertial_gradient);
        for (const ImpactRow& r : rows) g -= r.stiffness * std::max(0.0, r.missing - row(r).dot(p)) * row(r);
        return g;
    }
    double energy(const VectorX& p) const {
        double e = 0.5 * p.dot(mass() * p) + flatten(inertial_gradient).dot(p);
        for (const ImpactRow& r : rows) e += 0.5 * r.stiffness * std::pow(std::max(0.0, r.missing - row(r).dot(p)), 2);
        return e;
    }
    int solve(Coordinates& p) const {
        BlockSystem system;
        system.set_pattern(pattern());
        const BlockSystem* nodes = zone.node_count() > 0 ? &cloth : nullptr;
        return solve_impact_qp(zone, inertial_gradient, mass_factor, nodes, rows, system, p);
    }
    /// Every pair that there can be.
    BlockPattern pattern() const {
        BlockPattern result{zone.dynamic_count, zone.node_count(), zone.pairs, {}, {}};
        for (int j = 0; j < zone.node_count(); ++j)
            for (int i = 0; i < j; ++i) result.node_pairs.emplace_back(i, j);
        for (int i = 0; i < zone.dynamic_count; ++i)
            for (int j = 0; j < zone.node_count(); ++j) result.mixed_pairs.emplace_back(i, j);
        std::sort(result.node_pairs.begin(), result.node_pairs.end());
        return result;
    }
    /// The dual, one multiplier at a time:  p = M⁻¹ (Σ λ r - g),  0 ≤ λ = stiffness · violation. Slow and plain.
    VectorX reference(int sweeps) const {
        const MatrixX inverse = mass().inverse();
        std::vector<VectorX> full, push;
        for (const ImpactRow& r : rows) {
            full.push_back(row(r));
            push.push_back(inverse * full.back());
        }
        VectorX p = -(inverse * flatten(inertial_gradient));
        VectorX multipliers = VectorX::Zero(static_cast<Eigen::Index>(rows.size()));
        for (int sweep = 0; sweep < sweeps; ++sweep)
            for (std::size_t k = 0; k < rows.size(); ++k) {
                double& multiplier = multipliers[static_cast<Eigen::Index>(k)];
                const double softness = 1.0 / rows[k].stiffness;
                const double residual = rows[k].missing - full[k].dot(p) - softness * multiplier;
                const double next = std::max(0.0, multiplier + residual / (softness + full[k].dot(push[k])));
                p += (next - multiplier) * push[k];
                multiplier = next;
            }
        return p;
    }
};

Problem random_problem(check::Random& random, int bodies, int row_count, double stiffness) {
    Problem problem;
    Zone& zone = problem.zone;
    zone.dynamic_count = bodies;
    for (int i = 0; i < bodies; ++i) {
        const double mass = random.uniform(0.5, 5.0);
        zone.bodies.push_back(fixtures::zone_body(i, Pose(), mass, mass * fixtures::random_inertia(random, 4.0)));
        problem.inertial_gradient.bodies.push_back(random.vector(6));
        problem.mass_factor.push_back(i % 2 == 0 ? 1.0 : 3.0);
        for (int j = i + 1; j < bodies; ++j) zone.pairs.emplace_back(i, j);
    }
    for (int k = 0; k < row_count; ++k) {
        ImpactRow row;
        row.a = static_cast<int>(random.uniform(0.0, bodies));
        row.b = static_cast<int>(random.uniform(0.0, bodies));
        if (row.b == row.a) row.b = -1;
        if (row.b >= 0 && row.a > row.b) std::swap(row.a, row.b);
        if (row.b < 0 && k % 2 == 0) std::swap(row.a, row.b);  // the partner that does not yield may be either
        const auto found = std::find(zone.pairs.begin(), zone.pairs.end(), std::pair(row.a, row.b));
        row.pair = found == zone.pairs.end() ? -1 : static_cast<int>(found - zone.pairs.begin());
        const Vec3 n = random_direction(random);
        row.relative << fixtures::random_vec3(random), fixtures::random_vec3(random), -n;
        row.missing = random.uniform(-0.5, 0.5);
        row.stiffness = stiffness * random.uniform(0.5, 2.0);
        problem.rows.push_back(row);
    }
    return problem;
}

/// The same with a sheet of 3 x 3 nodes, its first corner pinned: rows push bodies against features of one to six nodes.
Problem random_problem_with_nodes(check::Random& random, int bodies, int row_count, double stiffness) {
    Problem problem = random_problem(random, bodies, bodies > 0 ? row_count / 3 : 0, stiffness);
    constexpr int kNodes = 9;
    Zone& zone = problem.zone;
    zone.nodes.resize(kNodes);
    zone.nodes[0].pinned = true;
    problem.cloth.set_pattern({0, kNodes, {}, {}, {{1, 2}, {1, 4}, {2, 5}, {3, 4}, {4, 7}, {5, 8}, {6, 7}}});
    problem.cloth.set_zero();
    for (int i = 0; i < kNodes; ++i) {
        zone.nodes[i].mass = random.uniform(0.1, 0.5);
        const bool pinned = zone.nodes[i].pinned;
        problem.cloth.node_diagonal(i) = (pinned ? 1.0 : zone.nodes[i].mass) * Mat3::Identity();
        problem.inertial_gradient.nodes.push_back(pinned ? Vec3(Vec3::Zero()) : fixtures::random_vec3(random));
    }
    for (int k = 0; k < static_cast<int>(problem.cloth.pattern().node_pairs.size()); ++k) {
        const auto [i, j] = problem.cloth.pattern().node_pairs[static_cast<std::size_t>(k)];
        const MatrixX rows = random.matrix(6, 6), gram = 2.0 * rows * rows.transpose();
        problem.cloth.node_diagonal(i) += gram.topLeftCorner<3, 3>();
        problem.cloth.node_diagonal(j) += gram.bottomRightCorner<3, 3>();
        problem.cloth.node_pair(k) = gram.topRightCorner<3, 3>();
    }
    while (static_cast<int>(problem.rows.size()) < row_count) {
        ImpactRow row;
        const int sides = bodies > 0 && random.uniform() < 0.0 ? 1 : 2;
        const Vec3 n = random_direction(random);
        if (sides == 1) {
            row.a = static_cast<int>(random.uniform(0.0, bodies));
            row.relative << fixtures::random_vec3(random), Vec3::Zero(), -n;
        }
        std::vector<int> order(kNodes - 1);
        for (int i = 1; i < kNodes; ++i) order[static_cast<std::size_t>(i - 1)] = i;
        const int node_count = static_cast<int>(random.uniform(1.0, 3.0 * sides + 1.0));
        for (int k = 0; k < node_count; ++k) {
            const auto picked =
                order.begin() + static_cast<int>(random.uniform(0.0, static_cast<double>(order.size())));
            row.nodes.push_back(*picked);  // in any order
            order.erase(picked);
            row.node_rows.push_back(random.uniform(-1.0, 1.0) * n);
        }
        row.missing = random.uniform(-0.5, 0.5);
        row.stiffness = stiffness * random.uniform(0.5, 2.0);
        problem.rows.push_back(row);
    }
    return problem;
}

/// How many rows push at p.
int active_rows(const Problem& problem, const VectorX& p) {
    int count = 0;
    for (const ImpactRow& r : problem.rows) count += problem.row(r).dot(p) < r.missing ? 1 : 0;
    return count;
}

}  // namespace

TEST(impact_qp_ends_where_the_gradient_vanishes) {
    check::Random random(1);
    int some_active = 0, some_not = 0;
    for (const int bodies : {1, 2, 5, 12}) {
        for (const int rows_per_body : {0, 1, 3, 8}) {
            for (const double stiffness : {10.0, 1e4, 1e7}) {
                NOTE(bodies);
                NOTE(rows_per_body);
                NOTE(stiffness);
                const Problem problem = random_problem(random, bodies, bodies * rows_per_body, stiffness);
                Coordinates p = fixtures::unflatten(random.vector(6 * bodies));
                const double start = problem.gradient(flatten(p)).norm();
                const int steps = problem.solve(p);
                const VectorX g = problem.gradient(flatten(p));
                // What rounding leaves at stiff rows: eps · stiffness · |p|.
                const double noise = 1e-14 * stiffness * static_cast<double>(1 + problem.rows.size());
                CHECK(steps >= 1);
                CHECK(steps < 100);
                CHECK(g.norm() <= kOptimality * start + noise);
                const int active = active_rows(problem, flatten(p));
                some_active += active > 0 ? 1 : 0;
                some_not += active < static_cast<int>(problem.rows.size()) ? 1 : 0;
            }
        }
    }
    CHECK(some_active >= 20);
    CHECK(some_not >= 20);
}

TEST(impact_qp_agrees_with_a_slow_reference) {
    check::Random random(2);
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        const Problem problem = random_problem(random, 1 + k % 4, 3 + k % 7, 100.0);
        Coordinates p = fixtures::unflatten(VectorX::Zero(problem.size()));
        problem.solve(p);
        const VectorX found = flatten(p), reference = problem.reference(4000);
        CHECK_NEAR(found, reference, 1e-7 * (1.0 + reference.norm()));  // what the solver's tolerance is worth in p
        for (int trial = 0; trial < 10; ++trial)
            CHECK(problem.energy(found + 1e-3 * random.vector(found.size())) > problem.energy(found));
        cases_hit += active_rows(problem, found) >= 2 ? 1 : 0;
    }
    CHECK(cases_hit >= 10);
}

TEST(impact_qp_with_nodes_agrees_with_a_slow_reference) {
    check::Random random(5);
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        const Problem problem = random_problem_with_nodes(random, k % 4, 6 + k % 7, 100.0);
        Coordinates p = fixtures::unflatten(VectorX::Zero(problem.size()), problem.zone.dynamic_count);
        const double start = problem.gradient(flatten(p)).norm();
        const int steps = problem.solve(p);
        CHECK(steps >= 1);
        CHECK(steps < 100);
        CHECK(p.nodes[0].isZero(0.0));
        const VectorX found = flatten(p), reference = problem.reference(4000);
        CHECK(problem.gradient(found).norm() <= kOptimality * start + 1e-10);
        CHECK_NEAR(found, reference, 1e-7 * (1.0 + reference.norm()));
        cases_hit += active_rows(problem, found) >= 2 ? 1 : 0;
    }
    CHECK(cases_hit >= 10);
}

TEST(forces_of_impacts_give_what_the_qp_gives) {
    check::Random random(6);
    int cases_hit = 0;
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        Problem problem = random_problem_with_nodes(random, k % 4, 6 + k % 13, k % 2 == 0 ? 100.0 : 1e6);
        Coordinates expected = fixtures::unflatten(VectorX::Zero(problem.size()), problem.zone.dynamic_count);
        Coordinates p = expected;
        p.nodes[0] = expected.nodes[0] = Vec3(0.1, 0.2, 0.3);  // pinned
        problem.solve(expected);
        ImpactForces forces(problem.zone, problem.inertial_gradient, problem.cloth);
        int steps = 0;
        CHECK(forces.solve(problem.mass_factor, problem.rows, p, steps));
        CHECK(steps < 50);
        CHECK_NEAR(flatten(p), flatten(expected), 1e-7 * (1.0 + flatten(expected).norm()));
        CHECK(p.nodes[0] == Vec3(0.1, 0.2, 0.3));
        cases_hit += active_rows(problem, flatten(p)) >= 2 ? 1 : 0;

        // The same from other starts: with heavier bodies, with rows that come later, from its own end.
        for (double& factor : problem.mass_factor) factor *= 2.0;
        problem.solve(expected);
        CHECK(forces.solve(problem.mass_factor, problem.rows, p, steps));
        CHECK_NEAR(flatten(p), flatten(expected), 1e-7 * (1.0 + flatten(expected).norm()));
        ImpactForces anew(problem.zone, problem.inertial_gradient, problem.cloth);
        const std::vector<ImpactRow> first(problem.rows.begin(), problem.rows.begin() + 4);
        CHECK(anew.solve(problem.mass_factor, first, p, steps));
        CHECK(anew.solve(problem.mass_factor, problem.rows, p, steps));
        CHECK_NEAR(flatten(p), flatten(expected), 1e-7 * (1.0 + flatten(expected).norm()));
        ImpactForces again(problem.zone, problem.inertial_gradient, problem.cloth);
        again.start_from(problem.rows, p);
        CHECK(again.solve(problem.mass_factor, problem.rows, p, steps));
        CHECK(steps <= 2);
        CHECK_NEAR(flatten(p), flatten(expected), 1e-7 * (1.0 + flatten(expected).norm()));
    }
    CHECK(cases_hit >= 20);
}

TEST(too_many_forces_of_impacts_are_left_to_the_qp) {
    check::Random random(7);
    Problem problem = random_problem_with_nodes(random, 0, 200, 100.0);  // 10 per root of 9 nodes are too many
    for (ImpactRow& row : problem.rows) row.missing = 10.0;
    ImpactForces forces(problem.zone, problem.inertial_gradient, problem.cloth);
    Coordinates p = fixtures::unflatten(VectorX::Zero(problem.size()), 0);
    int steps = 0;
    CHECK(!forces.solve(problem.mass_factor, problem.rows, p, steps));
    CHECK(flatten(p).isZero(0.0));
}

TEST(impact_qp_does_not_depend_on_the_start) {
    check::Random random(3);
    for (int k = 0; k < 10; ++k) {
        NOTE(k);
        const Problem problem = random_problem(random, 3, 10, 1e4);
        Coordinates near = fixtures::unflatten(VectorX::Zero(18)), far = fixtures::unflatten(100.0 * random.vector(18));
        problem.solve(near);
        problem.solve(far);
        CHECK(flatten(near).norm() > 1e-3);
        CHECK_NEAR(flatten(far), flatten(near), 1e-5);  // 1e-9 of a gradient of about 1e6, over masses of about 1
    }
}

TEST(impact_qp_takes_no_steps_from_its_solution) {
    check::Random random(5);
    for (const double stiffness : {10.0, 1e4, 1e7}) {
        for (int k = 0; k < 20; ++k) {
            NOTE(stiffness);
            NOTE(k);
            const Problem problem = random_problem(random, 4, 12, stiffness);
            Coordinates p = fixtures::unflatten(VectorX::Zero(24));
            CHECK(problem.solve(p) >= 1);
            const VectorX found = flatten(p);
            CHECK(active_rows(problem, found) >= 1);
            CHECK(problem.solve(p) <= 1);
            CHECK_NEAR(flatten(p), found, 1e-7 * found.norm());
        }
    }
}

TEST(impact_qp_serves_light_bodies_beside_heavy_ones) {
    constexpr double kHeavy = 1e10;
    check::Random random(6);
    for (int k = 0; k < 10; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 3, 10, 1e4);
        Coordinates alone = fixtures::unflatten(VectorX::Zero(18)), beside = fixtures::unflatten(VectorX::Zero(24));
        problem.solve(alone);
        CHECK(active_rows(problem, flatten(alone)) >= 1);
        // A heavy body that nothing touches, where it goes.
        problem.zone.bodies.push_back(fixtures::zone_body(3, Pose(), kHeavy, kHeavy * Mat3::Identity()));
        problem.zone.dynamic_count = 4;
        problem.inertial_gradient.bodies.push_back(kHeavy * Vec6::Ones());
        problem.mass_factor.push_back(1.0);
        beside.bodies[3] = -Vec6::Ones();
        problem.solve(beside);
        CHECK_NEAR(VectorX(flatten(beside).head(18)), flatten(alone), 1e-7 * flatten(alone).norm());
    }
}

TEST(without_rows_bodies_go_to_their_targets) {
    check::Random random(4);
    const Problem problem = random_problem(random, 2, 0, 1.0);
    Coordinates p = fixtures::unflatten(VectorX::Zero(12));
    problem.solve(p);
    const VectorX expected = -(problem.mass().inverse() * flatten(problem.inertial_gradient));
    CHECK_NEAR(flatten(p), expected, 1e-13);
}

TEST(a_row_that_wants_more_is_met_as_far_as_masses_and_stiffness_say) {
    // One body of mass m pushed along z by one row through its centre: m p = k (missing - p).
    Problem problem;
    problem.zone.dynamic_count = 1;
    problem.zone.bodies.push_back(fixtures::zone_body(0, Pose(), 2.0, Mat3::Identity()));
    problem.inertial_gradient.assign_zero(1, 0);
    problem.mass_factor = {1.0};
    ImpactRow row;
    row.a = 0;
    row.relative = -Vector<9>::Unit(8);  // a's shift is the opposite of b's
    row.missing = 0.3;
    row.stiffness = 6.0;
    problem.rows.push_back(row);
    Coordinates p = fixtures::unflatten(VectorX::Zero(6));
    problem.solve(p);
    CHECK_NEAR(p.bodies[0], 0.3 * 6.0 / 8.0 * Vec6::Unit(5), 1e-14);
}
