#include "solve/contact_model.hpp"

#include <algorithm>
#include <cmath>

#include "fixtures.hpp"

namespace test_contact_model {

using namespace diffsim;
using fixtures::flatten;
using fixtures::random_direction;

namespace {

constexpr double kAgreement = 1e-9;  // of the minimiser, beside the reference's: both are at rounding
constexpr double kRange = 1e-4;      // of the rows [m]; which side of 1e-9 of it a row ends on is left open

struct Problem {
    ContactModel model;

    int body_count() const { return model.smooth.pattern().body_count; }
    int node_count() const { return model.smooth.pattern().node_count; }
    Eigen::Index size() const { return 6 * body_count() + 3 * node_count(); }
    MatrixX smooth() const { return fixtures::dense(model.smooth); }
    VectorX row(const ContactRow& r) const {
        VectorX full = VectorX::Zero(size());
        if (r.a >= 0) full.segment<6>(6 * r.a) = r.row_a();
        if (r.b >= 0) full.segment<6>(6 * r.b) = r.row_b();
        for (std::size_t k = 0; k < r.nodes.size(); ++k)
            full.segment<3>(6 * body_count() + 3 * r.nodes[k]) = r.node_rows[k];
        return full;
    }
    double violation(const ContactRow& r, const VectorX& p) const { return std::max(0.0, r.missing - row(r).dot(p)); }
    VectorX gradient(const VectorX& p) const {
        VectorX g = smooth() * p + flatten(model.gradient);
        for (const ContactRow& r : model.rows) g -= r.stiffness * violation(r, p) * row(r);
        return g;
    }
    double energy(const VectorX& p) const {
        double e = 0.5 * p.dot(smooth() * p) + flatten(model.gradient).dot(p);
        for (const ContactRow& r : model.rows) e += 0.5 * r.stiffness * std::pow(violation(r, p), 2);
        return e;
    }
    Coordinates zero() const { return fixtures::unflatten(VectorX::Zero(size()), body_count()); }
    int pushing(const VectorX& p) const {
        return static_cast<int>(std::count_if(
            model.rows.begin(), model.rows.end(), [&](const ContactRow& r) { return violation(r, p) > 0.0; }));
    }
    void forget_forces() {
        for (ContactRow& r : model.rows) r.force = 0.0;
    }
    ModelSolution solve(Coordinates& p, double share = 1.0, double least_step = 0.0) {
        BlockSystem system;
        system.set_pattern(model.smooth.pattern());
        ModelWorkspace workspace;
        return minimise(model, share, least_step, system, workspace, p);
    }
    /// The minimiser, found with no guess of who pushes.
    VectorX minimiser() {
        Coordinates p = zero();
        forget_forces();
        CHECK(solve(p).status == ModelSolution::Status::solved);
        return flatten(p);
    }
    /// The dual, one multiplier at a time:  p = H⁻¹ (Σ λ r - g),  0 ≤ λ = stiffness · violation. Slow and plain.
    VectorX reference(int sweeps) const {
        const MatrixX inverse = smooth().inverse();
        std::vector<VectorX> full, push;
        for (const ContactRow& r : model.rows) {
            full.push_back(row(r));
            push.push_back(inverse * full.back());
        }
        VectorX p = -(inverse * flatten(model.gradient));
        VectorX multipliers = VectorX::Zero(static_cast<Eigen::Index>(full.size()));
        for (int sweep = 0; sweep < sweeps; ++sweep)
            for (std::size_t k = 0; k < full.size(); ++k) {
                double& multiplier = multipliers[static_cast<Eigen::Index>(k)];
                const double softness = 1.0 / model.rows[k].stiffness;
                const double residual = model.rows[k].missing - full[k].dot(p) - softness * multiplier;
                const double next = std::max(0.0, multiplier + residual / (softness + full[k].dot(push[k])));
                p += (next - multiplier) * push[k];
                multiplier = next;
            }
        return p;
    }
};

/// Rows of the same bodies follow each other, as those of a zone do.
void sort_rows(std::vector<ContactRow>& rows) {
    std::stable_sort(rows.begin(), rows.end(), [](const ContactRow& r, const ContactRow& s) {
        return std::pair(r.a, r.b) < std::pair(s.a, s.b);
    });
}

/// Every pair that there can be.
BlockPattern full_pattern(int bodies, int nodes) {
    BlockPattern pattern{bodies, nodes, {}, {}, {}};
    for (int i = 0; i < bodies; ++i) {
        for (int j = i + 1; j < bodies; ++j) pattern.body_pairs.emplace_back(i, j);
        for (int j = 0; j < nodes; ++j) pattern.mixed_pairs.emplace_back(i, j);
    }
    for (int i = 0; i < nodes; ++i)
        for (int j = i + 1; j < nodes; ++j) pattern.node_pairs.emplace_back(i, j);
    return pattern;
}

void add_body_rows(Problem& problem, check::Random& random, int count, double stiffness) {
    const IndexPairs& pairs = problem.model.smooth.pattern().body_pairs;
    const int bodies = problem.body_count();
    for (int k = 0; k < count; ++k) {
        ContactRow row;
        row.a = static_cast<int>(random.uniform(0.0, bodies));
        row.b = static_cast<int>(random.uniform(0.0, bodies));
        if (row.b == row.a) row.b = -1;
        if (row.b >= 0 && row.a > row.b) std::swap(row.a, row.b);
        if (row.b >= 0 && random.uniform() < -0.8) row.a = -1;  // what does not yield may be either
        const auto found = std::find(pairs.begin(), pairs.end(), std::pair(row.a, row.b));
        row.pair = found == pairs.end() ? -1 : static_cast<int>(found - pairs.begin());
        row.relative << fixtures::random_vec3(random), fixtures::random_vec3(random), -random_direction(random);
        row.missing = random.uniform(-0.5, 0.5);
        row.stiffness = stiffness * random.uniform(0.5, 2.0);
        row.range = kRange;
        problem.model.rows.push_back(row);
    }
}

/// Rows that push a body, or nothing, against features of one to six of the free nodes.
void add_node_rows(Problem& problem, check::Random& random, int count, double stiffness) {
    const int bodies = problem.body_count();
    for (int k = 0; k < count; ++k) {
        ContactRow row;
        const int sides = bodies > 0 && random.uniform() < 0.0 ? 1 : 2;
        const Vec3 n = random_direction(random);
        if (sides == 1) {
            row.a = static_cast<int>(random.uniform(0.0, bodies));
            row.relative << fixtures::random_vec3(random), Vec3::Zero(), -n;
        }
        std::vector<int> order;
        for (int i = 1; i < problem.node_count(); ++i) order.push_back(i);
        const int node_count = static_cast<int>(random.uniform(1.0, 3.0 * sides + 1.0));
        for (int i = 0; i < node_count; ++i) {
            const auto picked =
                order.begin() + static_cast<int>(random.uniform(0.0, static_cast<double>(order.size())));
            row.nodes.push_back(*picked);  // in any order
            order.erase(picked);
            row.node_rows.push_back(random.uniform(-1.0, 1.0) * n);
        }
        row.missing = random.uniform(-0.5, 0.5);
        row.stiffness = stiffness * random.uniform(0.5, 2.0);
        row.range = kRange;
        problem.model.rows.push_back(row);
    }
}

/// `heavy`: how much heavier every other body is, and the force on it.
Problem random_problem(check::Random& random, int bodies, int row_count, double stiffness, double heavy = 1.0) {
    Problem problem;
    BlockSystem& smooth = problem.model.smooth;
    smooth.set_pattern(full_pattern(bodies, 0));
    smooth.set_zero();
    for (int i = 0; i < bodies; ++i) {
        const double scale = i % 2 == 0 ? 1.0 : heavy;
        const MatrixX rows = random.matrix(6, 6);
        smooth.diagonal(i) = scale * (Mat6::Identity() + rows * rows.transpose());
        problem.model.gradient.bodies.push_back(scale * random.vector(6));
    }
    add_body_rows(problem, random, row_count, stiffness);
    sort_rows(problem.model.rows);
    return problem;
}

/// The same with nodes that couple, the first of them pinned.
Problem random_problem_with_nodes(check::Random& random, int bodies, int row_count, double stiffness) {
    constexpr int kNodes = 9;
    Problem problem;
    BlockSystem& smooth = problem.model.smooth;
    smooth.set_pattern(full_pattern(bodies, kNodes));
    smooth.set_zero();
    for (int i = 0; i < bodies; ++i) {
        const MatrixX rows = random.matrix(6, 6);
        smooth.diagonal(i) = Mat6::Identity() + rows * rows.transpose();
        problem.model.gradient.bodies.push_back(random.vector(6));
    }
    for (int i = 0; i < kNodes; ++i) {
        smooth.node_diagonal(i) = (i == 0 ? 1.0 : random.uniform(0.1, 0.5)) * Mat3::Identity();
        problem.model.gradient.nodes.push_back(i == 0 ? Vec3(Vec3::Zero()) : fixtures::random_vec3(random));
    }
    for (int i = 1; i + 1 < kNodes; ++i) {
        const MatrixX rows = random.matrix(6, 6), gram = 2.0 * rows * rows.transpose();
        smooth.node_diagonal(i) += gram.topLeftCorner<3, 3>();
        smooth.node_diagonal(i + 1) += gram.bottomRightCorner<3, 3>();
        smooth.node_pair(smooth.find_node_pair(i, i + 1)) = gram.topRightCorner<3, 3>();
    }
    if (bodies > 0) add_body_rows(problem, random, row_count / 3, stiffness);
    add_node_rows(problem, random, row_count - static_cast<int>(problem.model.rows.size()), stiffness);
    sort_rows(problem.model.rows);
    return problem;
}

/// Bodies in a line along z, each `gap` from the next, the first of them pushed into the others.
Problem random_chain(check::Random& random, int bodies, double gap, double stiffness) {
    Problem problem;
    BlockSystem& smooth = problem.model.smooth;
    smooth.set_pattern(full_pattern(bodies, 0));
    smooth.set_zero();
    for (int i = 0; i < bodies; ++i) smooth.diagonal(i) = random.uniform(0.5, 2.0) * Mat6::Identity();
    problem.model.gradient = problem.zero();
    problem.model.gradient.bodies[0][5] = -1.0;
    const IndexPairs& pairs = smooth.pattern().body_pairs;
    for (int i = 0; i + 1 < bodies; ++i) {
        ContactRow row;
        row.a = i;
        row.b = i + 1;
        row.pair = static_cast<int>(std::find(pairs.begin(), pairs.end(), std::pair(i, i + 1)) - pairs.begin());
        row.relative = Vector<9>::Unit(8);  // b's shift, less a's
        row.missing = -gap * random.uniform(0.5, 2.0);
        row.stiffness = stiffness;
        row.range = kRange;
        problem.model.rows.push_back(row);
    }
    return problem;
}

void check_forces(const Problem& problem, const VectorX& p, double share = 1.0) {
    for (const ContactRow& r : problem.model.rows) {
        const double expected = share * r.stiffness * problem.violation(r, p);
        CHECK_NEAR(r.force, expected, 1e-12 * share * r.stiffness * (1.0 + p.norm()));
    }
}

}  // namespace

TEST(a_row_that_wants_more_is_met_as_far_as_masses_and_stiffness_say) {
    // One body of mass m pushed along z by one row through its centre: m p = k (missing - p).
    Problem problem;
    problem.model.smooth.set_pattern(full_pattern(1, 0));
    problem.model.smooth.set_zero();
    problem.model.smooth.diagonal(0) = 2.0 * Mat6::Identity();
    problem.model.gradient = problem.zero();
    ContactRow row;
    row.a = 0;
    row.relative = -Vector<9>::Unit(8);  // a's shift is the opposite of b's
    row.missing = 0.3;
    row.stiffness = 6.0;
    problem.model.rows.push_back(row);
    Coordinates p = problem.zero();
    CHECK(problem.solve(p).newton_steps == 1);
    CHECK_NEAR(p.bodies[0], 0.3 * 6.0 / 8.0 * Vec6::Unit(5), 1e-14);
    CHECK_NEAR(problem.model.rows[0].force, 2.0 * 0.3 * 6.0 / 8.0, 1e-14);
}

TEST(a_model_without_rows_is_minimised_by_one_factor) {
    check::Random random(1);
    for (const int bodies : {1, 3, 12}) {
        Problem problem = random_problem(random, bodies, 0, 1.0);
        Coordinates p = fixtures::unflatten(random.vector(problem.size()));
        CHECK(problem.solve(p).newton_steps == 1);
        CHECK_NEAR(flatten(p), -problem.smooth().ldlt().solve(flatten(problem.model.gradient)), 1e-12);
    }
}

TEST(models_end_where_their_gradient_vanishes) {
    check::Random random(2);
    int some_push = 0, some_do_not = 0;
    for (const int bodies : {1, 2, 5, 12}) {
        for (const int rows_per_body : {1, 3, 8}) {
            for (const double stiffness : {10.0, 1e4, 1e7}) {
                NOTE(bodies);
                NOTE(rows_per_body);
                NOTE(stiffness);
                Problem problem = random_problem(random, bodies, bodies * rows_per_body, stiffness);
                Coordinates p = fixtures::unflatten(random.vector(6 * bodies));
                const ModelSolution solution = problem.solve(p);
                CHECK(solution.status == ModelSolution::Status::solved);
                CHECK(solution.newton_steps < 100);
                // What rounding leaves at stiff rows: eps · stiffness · |p|, a few times over.
                const double noise = 1e-14 * stiffness * static_cast<double>(1 + problem.model.rows.size());
                CHECK(problem.gradient(flatten(p)).norm() <= 1e-12 + noise);
                check_forces(problem, flatten(p));
                const int pushing = problem.pushing(flatten(p));
                some_push += pushing > 0 ? 1 : 0;
                some_do_not += pushing < static_cast<int>(problem.model.rows.size()) ? 1 : 0;
            }
        }
    }
    CHECK(some_push >= 20);
    CHECK(some_do_not >= 20);
}

TEST(models_agree_with_a_slow_reference) {
    check::Random random(3);
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 1 + k % 4, 3 + k % 7, 100.0);
        const VectorX found = problem.minimiser(), reference = problem.reference(4000);
        CHECK_NEAR(found, reference, kAgreement * (1.0 + reference.norm()));
        for (int trial = 0; trial < 10; ++trial)
            CHECK(problem.energy(found + 1e-3 * random.vector(found.size())) > problem.energy(found));
        cases_hit += problem.pushing(found) >= 2 ? 1 : 0;
    }
    CHECK(cases_hit >= 10);
}

TEST(models_with_nodes_agree_with_a_slow_reference) {
    check::Random random(4);
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        Problem problem = random_problem_with_nodes(random, k % 4, 6 + k % 7, 100.0);
        const VectorX found = problem.minimiser(), reference = problem.reference(4000);
        CHECK_NEAR(found, reference, kAgreement * (1.0 + reference.norm()));
        CHECK(found.segment<3>(6 * problem.body_count()).isZero(0.0));  // the pinned one
        check_forces(problem, found);
        cases_hit += problem.pushing(found) >= 2 ? 1 : 0;
    }
    CHECK(cases_hit >= 10);
}

TEST(pinned_nodes_stay_where_the_start_has_them) {
    check::Random random(5);
    Problem problem = random_problem_with_nodes(random, 2, 12, 100.0);
    const VectorX expected = problem.minimiser();
    CHECK(problem.pushing(expected) >= 2);
    Coordinates p = problem.zero();
    p.nodes[0] = Vec3(0.1, 0.2, 0.3);  // of its own: it couples with nothing
    problem.model.gradient.nodes[0] = -p.nodes[0];
    problem.forget_forces();
    CHECK(problem.solve(p).status == ModelSolution::Status::solved);
    CHECK_NEAR(p.nodes[0], Vec3(0.1, 0.2, 0.3), 1e-15);
    p.nodes[0].setZero();
    CHECK_NEAR(flatten(p), expected, kAgreement);
}

TEST(light_bodies_beside_heavy_ones_are_found_as_well) {
    check::Random random(6);
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 2 + k % 4, 4 + k % 7, 100.0, 1e6);
        const VectorX found = problem.minimiser(), reference = problem.reference(4000);
        for (int i = 0; i < problem.body_count(); ++i)
            CHECK_NEAR(found.segment<6>(6 * i), reference.segment<6>(6 * i), kAgreement * (1.0 + reference.norm()));
        cases_hit += problem.pushing(found) >= 2 ? 1 : 0;
    }
    CHECK(cases_hit >= 10);
}

TEST(rows_that_say_the_same_share_the_force) {
    check::Random random(7);
    constexpr int kCopies = 20;
    int cases_hit = 0;
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 3, 8, 1e4);
        const VectorX expected = problem.minimiser();
        const std::vector<ContactRow> once = problem.model.rows;
        problem.model.rows.clear();
        for (const ContactRow& row : once)
            for (int copy = 0; copy < kCopies; ++copy) {
                problem.model.rows.push_back(row);
                problem.model.rows.back().stiffness /= kCopies;
            }
        CHECK_NEAR(problem.minimiser(), expected, kAgreement * (1.0 + expected.norm()));
        for (std::size_t r = 0; r < problem.model.rows.size(); ++r) {
            const double force = once[r / kCopies].force;
            CHECK_NEAR(kCopies * problem.model.rows[r].force, force, 1e-7 * (1.0 + force));
            cases_hit += force > 0.0 ? 1 : 0;
        }
    }
    CHECK(cases_hit >= 10 * kCopies);
}

TEST(the_right_guess_of_who_pushes_takes_one_factor) {
    check::Random random(8);
    int cases_hit = 0;
    for (const double stiffness : {10.0, 1e4, 1e7}) {
        for (int k = 0; k < 20; ++k) {
            NOTE(stiffness);
            NOTE(k);
            Problem problem = random_problem_with_nodes(random, k % 4, 12, stiffness);
            const VectorX expected = problem.minimiser();
            if (problem.pushing(expected) == 0) continue;  // that is no guess
            Coordinates p = fixtures::unflatten(random.vector(problem.size()), problem.body_count());
            p.nodes[0].setZero();
            const ModelSolution solution = problem.solve(p);
            CHECK(solution.status == ModelSolution::Status::solved);
            CHECK(solution.newton_steps == 1);
            CHECK_NEAR(flatten(p), expected, (kAgreement + 1e-15 * stiffness) * (1.0 + expected.norm()));
            ++cases_hit;
        }
    }
    CHECK(cases_hit >= 50);
}

TEST(a_wrong_guess_of_who_pushes_ends_at_the_same_minimiser) {
    check::Random random(9);
    int cases_hit = 0;
    for (int k = 0; k < 40; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 4, 16, k % 2 == 0 ? 100.0 : 1e6);
        const VectorX expected = problem.minimiser();
        for (ContactRow& r : problem.model.rows) r.force = r.force > 0.0 ? 0.0 : 1.0;
        Coordinates p = problem.zero();
        const ModelSolution solution = problem.solve(p);
        CHECK(solution.status == ModelSolution::Status::solved);
        CHECK_NEAR(flatten(p), expected, kAgreement * (1.0 + expected.norm()));
        cases_hit += solution.newton_steps > 1 ? 1 : 0;
    }
    CHECK(cases_hit >= 30);
}

TEST(models_do_not_depend_on_the_start) {
    check::Random random(10);
    for (int k = 0; k < 10; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 3, 10, 1e4);
        const VectorX expected = problem.minimiser();
        problem.forget_forces();
        Coordinates far = fixtures::unflatten(100.0 * random.vector(18));
        CHECK(problem.solve(far).status == ModelSolution::Status::solved);
        CHECK(expected.norm() > 1e-3);
        CHECK_NEAR(flatten(far), expected, 1e-8);  // rounding of the start, times the rows' stiffness over the masses
    }
}

TEST(a_share_of_the_stiffness_is_that_of_every_row) {
    check::Random random(11);
    int cases_hit = 0;
    for (const double share : {1e-3, 1e-2, 0.1}) {
        for (int k = 0; k < 10; ++k) {
            NOTE(share);
            NOTE(k);
            Problem problem = random_problem(random, 3, 12, 1e4);
            const std::vector<ContactRow> rows = problem.model.rows;
            for (ContactRow& row : problem.model.rows) row.stiffness *= share;
            const VectorX expected = problem.minimiser();
            problem.model.rows = rows;
            Coordinates p = problem.zero();
            CHECK(problem.solve(p, share).status == ModelSolution::Status::solved);
            CHECK_NEAR(flatten(p), expected, kAgreement * (1.0 + expected.norm()));
            check_forces(problem, flatten(p), share);
            cases_hit += problem.pushing(flatten(p)) > 0 ? 1 : 0;
        }
    }
    CHECK(cases_hit >= 25);
}

TEST(stages_of_stiffness_end_where_a_cold_start_does) {
    check::Random random(12);
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        Problem problem = random_problem(random, 4, 20, 1e6);
        const VectorX expected = problem.minimiser();
        problem.forget_forces();
        Coordinates p = problem.zero();
        for (const double share : {1e-3, 1e-2, 0.1, 1.0})
            CHECK(problem.solve(p, share).status == ModelSolution::Status::solved);
        CHECK_NEAR(flatten(p), expected, kAgreement * (1.0 + expected.norm()));
        check_forces(problem, flatten(p));
    }
}

TEST(an_indefinite_model_is_told_apart) {
    check::Random random(13);
    for (const int bodies : {1, 3, 12}) {
        NOTE(bodies);
        Problem problem = random_problem(random, bodies, 2 * bodies, 100.0);
        problem.model.smooth.diagonal(0)(3, 3) = -1e6;  // more than all rows hold
        Coordinates p = problem.zero();
        CHECK(problem.solve(p).status == ModelSolution::Status::indefinite);
        for (const ContactRow& row : problem.model.rows) CHECK(row.force == 0.0);
    }
}

TEST(crawling_is_told_where_least_steps_are_asked_for) {
    check::Random random(14);
    for (int k = 0; k < 5; ++k) {
        NOTE(k);
        Problem problem = random_chain(random, 30, 1e-3, 1e4);
        const VectorX expected = problem.minimiser();
        CHECK(problem.pushing(expected) >= 10);
        CHECK_NEAR(expected, problem.reference(20000), 1e-7);
        // More steps than are taken whole, so that some are searched along.
        Coordinates p = problem.zero();
        problem.forget_forces();
        CHECK(problem.solve(p).newton_steps > 9);
        p = problem.zero();
        problem.forget_forces();
        CHECK(problem.solve(p, 1.0, kInfinity).status == ModelSolution::Status::crawling);
        for (const ContactRow& row : problem.model.rows) CHECK(row.force == 0.0);
    }
}

}  // namespace test_contact_model
