#include "solve/friction_model.hpp"

#include <cmath>

#include "fixtures.hpp"

namespace test_friction_model {

using namespace diffsim;
using fixtures::flatten;

namespace {

constexpr double kStiffness = 100.0;
constexpr double kTolerance = 1e-12;

/// Two bodies in contact with the ground and each other, some contacts pulled harder than friction holds.
struct Problem {
    Zone zone;
    ContactModel model;
    BlockSystem system;
    BalanceWorkspace workspace;
    Coordinates p;

    explicit Problem(check::Random& random) {
        for (int i = 0; i < 2; ++i) zone.bodies.push_back(fixtures::zone_body(i, Pose(), 1.0, Mat3::Identity()));
        zone.dynamic_count = 2;
        model.smooth.set_pattern({2, 0, {{0, 1}}, {}, {}});
        model.smooth.set_zero();
        for (int i = 0; i < 2; ++i) {
            const MatrixX rows = 0.3 * random.matrix(6, 6);
            model.smooth.diagonal(i) = Mat6::Identity() + rows * rows.transpose();
            model.gradient.bodies.push_back(0.1 * random.vector(6));
        }
        for (const int b : {-1, 1})
            for (int k = 0; k < 3; ++k) add_contact(random, b);
        p.assign_zero(2, 0);
    }

    void add_contact(check::Random& random, int b) {
        const Mat3 frame = fixtures::random_rotation(random);
        const auto along = [&](const Vec3& direction) {
            Vector<9> relative;
            relative << 0.3 * fixtures::random_vec3(random), 0.3 * fixtures::random_vec3(random), -direction;
            if (b < 0) relative.segment<3>(3).setZero();
            return relative;
        };
        ContactRow row;
        row.a = 0;
        row.b = b;
        row.pair = b < 0 ? -1 : 0;
        row.relative = along(frame.col(2));
        row.missing = random.uniform(0.02, 0.05);
        row.stiffness = kStiffness;
        row.range = 0.1;
        FrictionRow slip;
        slip.normal = model.rows.size();
        slip.coefficient = 0.5;
        slip.tangents = {frame.col(0), frame.col(1)};
        slip.relative = {along(frame.col(0)), along(frame.col(1))};
        slip.slip = 0.002 * random.vector(2);
        model.rows.push_back(row);
        model.friction.push_back(slip);
    }

    /// What every contact's force and slip change by, as it turns.
    void add_turns(check::Random& random, double size) {
        for (std::size_t f = 0; f < model.friction.size(); ++f) {
            FrictionTurns::Slip turn;
            const bool of_two = model.rows[model.friction[f].normal].b >= 0;
            turn.side_count = of_two ? 2 : 1;
            for (int s = 0; s < 2; ++s) {
                turn.sides[static_cast<std::size_t>(s)].body = s == 0 || of_two ? s : kNobody;
                turn.sides[static_cast<std::size_t>(s)].offset = 6 * s;
            }
            const Eigen::Index n = of_two ? 12 : 6;
            turn.friction = f;
            turn.rows.resize(n, 2);
            for (int k = 0; k < 2; ++k)
                turn.rows.col(k) = both_twists(model.friction[f].relative[static_cast<std::size_t>(k)]).head(n);
            turn.beyond = size * random.matrix(2, n);
            turn.force = model.turns.forces.add(turn, SmallMatrix(size * random.matrix(n, n)));
            model.turns.slips.push_back(turn);
        }
    }

    /// To the next model, which begins with the last one's forces and states.
    void go_on() {
        p.assign_zero(2, 0);
        for (FrictionRow& slip : model.friction) {
            slip.multiplier = slip.share;
            slip.is_known = true;
        }
    }

    ModelSolution solve() {
        system.set_pattern(model.smooth.pattern());
        return balance(model, zone, {kTolerance, false, true, false}, system, workspace, p);
    }

    /// From nowhere, with the bounds and reaches of the last solution.
    ModelSolution solve_with_bounds_that_stand_still() {
        for (FrictionRow& slip : model.friction) slip.bound = slip.coefficient * model.rows[slip.normal].force;
        for (ContactRow& row : model.rows) row.force = 0.0;
        p.assign_zero(2, 0);
        return balance(model, zone, {kTolerance, false, false, false, true, true}, system, workspace, p);
    }

    /// A row along the coordinates of both bodies.
    static VectorX full(const ContactRow& row, const Vector<9>& relative) {
        VectorX result = both_twists(relative);
        if (row.b < 0) result.tail<6>().setZero();
        return result;
    }

    /// What is left of the balance at p, contact by contact.
    VectorX left() const {
        const VectorX x = flatten(p);
        Coordinates turned;
        turned.assign_zero(2, 0);
        model.turns.forces.add_product(zone, 1.0, p, turned);
        VectorX sum = fixtures::dense(model.smooth) * x + flatten(model.gradient) + flatten(turned);
        for (std::size_t f = 0; f < model.friction.size(); ++f) {
            const FrictionRow& slip = model.friction[f];
            const ContactRow& row = model.rows[slip.normal];
            const VectorX normal = full(row, row.relative);
            const double force = row.stiffness * std::max(0.0, row.missing - normal.dot(x));
            MatrixX tangents(12, 2);
            for (int k = 0; k < 2; ++k) tangents.col(k) = full(row, slip.relative[static_cast<std::size_t>(k)]);
            Vec2 w = slip.slip + slip.reach * slip.multiplier + tangents.transpose() * x;
            if (!model.turns.empty()) w += model.turns.slips[f].beyond * x.head(model.turns.slips[f].beyond.cols());
            sum += slip.coefficient * force / std::max(w.norm(), slip.reach) * (tangents * w) - force * normal;
        }
        return sum;
    }
};

}  // namespace

TEST(a_model_with_friction_is_in_balance_where_its_contacts_stick_and_slip) {
    check::Random random(5);
    int slipping = 0, sticking = 0;
    for (int trial = 0; trial < 20; ++trial) {
        Problem problem(random);
        CHECK(problem.solve().status == ModelSolution::Status::solved);
        CHECK(problem.left().norm() <= 10.0 * kTolerance);
        problem.go_on();
        problem.add_turns(random, 0.02);
        CHECK(problem.solve().status == ModelSolution::Status::solved);
        CHECK(!problem.model.turns.empty());  // it did not crawl
        CHECK(problem.left().norm() <= 10.0 * kTolerance);
        for (const FrictionRow& slip : problem.model.friction)
            if (problem.model.rows[slip.normal].force > 0.0) ++(slip.slips ? slipping : sticking);
    }
    CHECK(slipping >= 10);
    CHECK(sticking >= 10);
}

TEST(a_model_whose_bounds_stand_still_where_its_forces_have_them_has_the_same_solution) {
    check::Random random(6);
    for (int trial = 0; trial < 20; ++trial) {
        Problem problem(random);
        CHECK(problem.solve().status == ModelSolution::Status::solved);
        const VectorX followed = flatten(problem.p);
        const ModelSolution stood_still = problem.solve_with_bounds_that_stand_still();
        CHECK(stood_still.status == ModelSolution::Status::solved);
        CHECK(stood_still.newton_steps >= 1);
        CHECK(followed.norm() > 1e-3);
        CHECK_NEAR(flatten(problem.p), followed, 1e-5 * followed.norm());
        CHECK(problem.left().norm() <= 100.0 * kTolerance);

        for (FrictionRow& slip : problem.model.friction) slip.bound = 0.0;
        problem.p.assign_zero(2, 0);
        const BalanceGoal goal = {kTolerance, false, false, false, true, true};
        balance(problem.model, problem.zone, goal, problem.system, problem.workspace, problem.p);
        CHECK((flatten(problem.p) - followed).norm() > 1e-3 * followed.norm());  // bounds do matter
    }
}

TEST(a_model_that_crawls_with_turns_is_solved_without_them_from_the_states_it_began_with) {
    int crawled = 0;
    for (unsigned trial = 0; trial < 20; ++trial) {
        Coordinates solution;
        for (const bool turns : {false, true}) {
            check::Random random(trial);
            Problem problem(random);
            CHECK(problem.solve().status == ModelSolution::Status::solved);
            problem.go_on();
            if (turns) problem.add_turns(random, 100.0);  // so much that Newton's method may go to and fro
            CHECK(problem.solve().status == ModelSolution::Status::solved);
            if (!turns) {
                solution = problem.p;
            } else if (problem.model.turns.empty()) {
                ++crawled;
                CHECK(flatten(problem.p) == flatten(solution));
            }
        }
    }
    CHECK(crawled >= 5);
}

}  // namespace test_friction_model
