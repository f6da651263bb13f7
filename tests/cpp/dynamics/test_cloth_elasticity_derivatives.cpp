#include "dynamics/cloth_elasticity.hpp"

#include <Eigen/Eigenvalues>
#include <cmath>

#include "elasticity_fixtures.hpp"

namespace test_cloth_elasticity_derivatives {

using namespace diffsim;
using namespace fixtures::elasticity;
using fixtures::flatten_nodes;
using fixtures::shaken;
using fixtures::unflatten_nodes;

// --- derivatives by x ------------------------------------------------------------------------------------------------

TEST(gradient_and_hessian_agree_with_differences) {
    check::Random random(4);
    for (const Term term : {Term::stretch, Term::shear, Term::bend, Term::all, Term::all_undamped}) {
        NOTE(term);
        for (int k = 0; k < 3; ++k) {
            const Problem problem = random_problem(random, term);
            const VectorX x = flatten_nodes(problem.x);
            const auto energy = [&](const VectorX& at) { return problem.with_x(at).energy(); };
            const auto slope = [&](const VectorX& at) { return flatten_nodes(problem.with_x(at).gradient()); };
            const VectorX gradient = flatten_nodes(problem.gradient());
            CHECK(gradient.norm() > 1e-2);
            CHECK_NEAR(gradient, fixtures::numeric_gradient(energy, x, 1e-4), 1e-9 * (1.0 + gradient.norm()));

            const MatrixX hessian = problem.hessian(kNothingCut);
            CHECK(hessian.norm() > 1e-1);
            CHECK_NEAR(hessian, MatrixX(hessian.transpose()), kRounding * hessian.norm());
            CHECK_NEAR(hessian, fixtures::numeric_jacobian(slope, x, 1e-4), 1e-8 * hessian.norm());

            const Nodes direction = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
            const VectorX product = hessian * flatten_nodes(direction);
            CHECK_NEAR(flatten_nodes(problem.hessian_product(direction)), product, kRounding * (1.0 + hessian.norm()));
        }
    }
}

TEST(sums_are_added_with_their_scale) {
    check::Random random(5);
    const Problem problem = random_problem(random, Term::all);
    const ElasticStart start = problem.start();
    const Nodes gradient = problem.gradient(), before = shaken(problem.x, random, 1.0);
    Nodes sum = before;
    add_elastic_gradient(problem.cloth, problem.parameters, kDt, start, problem.x.data(), -0.3, sum.data());
    for (std::size_t i = 0; i < sum.size(); ++i) CHECK_NEAR(sum[i], before[i] - 0.3 * gradient[i], kRounding * 10.0);
    const Nodes product = problem.hessian_product(before);
    sum = before;
    add_elastic_hessian_product(
        problem.cloth, problem.parameters, kDt, start, problem.x.data(), before.data(), -0.3, sum.data());
    for (std::size_t i = 0; i < sum.size(); ++i) CHECK_NEAR(sum[i], before[i] - 0.3 * product[i], kRounding * 100.0);
}

TEST(forces_and_torques_add_to_nothing) {
    check::Random random(6);
    for (const Term term : {Term::stretch, Term::shear, Term::bend, Term::all}) {
        NOTE(term);
        const Problem problem = random_problem(random, term);
        const Nodes gradient = problem.gradient();
        CHECK(largest(gradient) > 1e-2);
        Vec3 force = Vec3::Zero(), torque = Vec3::Zero();
        for (std::size_t i = 0; i < gradient.size(); ++i) {
            force += gradient[i];
            torque += problem.x[i].cross(gradient[i]);
        }
        CHECK_NEAR(force, Vec3(Vec3::Zero()), 10.0 * kRounding);
        CHECK_NEAR(torque, Vec3(Vec3::Zero()), 10.0 * kRounding);
    }
}

TEST(projected_triangles_are_semidefinite_and_exact_where_those_are) {
    check::Random random(7);
    int same = 0, different = 0;
    for (int k = 0; k < 30; ++k) {
        Problem problem = random_problem(random, k % 2 == 0 ? Term::all : Term::all_undamped);
        for (Vec3& node : problem.x) node *= 1.0 + 0.02 * (k - 15);  // crushed to stretched
        const ElasticStart start = problem.start();
        const ElasticLaw law = elastic_law(problem.cloth, problem.parameters, kDt);
        for (int t = 0; t < static_cast<int>(problem.cloth.triangles.size()); ++t) {
            const auto matrix = [&](CutShare cut) -> MatrixX {
                return triangle_hessian(problem.cloth, law, start, problem.x.data(), t, cut).matrix;
            };
            const MatrixX projected = matrix(kAllCut), exact = matrix(kNothingCut);
            const double size = exact.norm();
            const double lowest = Eigen::SelfAdjointEigenSolver<MatrixX>(projected).eigenvalues()[0];
            const double lowest_exact = Eigen::SelfAdjointEigenSolver<MatrixX>(exact).eigenvalues()[0];
            CHECK(lowest > -kRounding * size);
            if (lowest_exact > -kRounding * size) {
                CHECK_NEAR(projected, exact, kRounding * size);
                ++same;
            } else {
                CHECK((projected - exact).norm() > kRounding * size);
                ++different;
            }
        }
    }
    CHECK(same >= 50);
    CHECK(different >= 100);
}

TEST(the_projected_hessian_is_semidefinite) {
    check::Random random(12);
    int indefinite = 0;
    for (int k = 0; k < 20; ++k) {
        const Problem problem = random_problem(random, k % 2 == 0 ? Term::bend : Term::all);
        const auto lowest = [&](CutShare cut) {
            const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(problem.hessian(cut));
            return eigen.eigenvalues()[0] / eigen.eigenvalues().tail(1)[0];
        };
        CHECK(lowest(kAllCut) > -kRounding);
        indefinite += lowest(kNothingCut) < -1e-6 ? 1 : 0;
    }
    CHECK(indefinite >= 15);
}

TEST(a_share_of_the_cut_lies_between_nothing_and_all) {
    check::Random random(13);
    const Problem problem = random_problem(random, Term::all);
    const MatrixX exact = problem.hessian(kNothingCut), projected = problem.hessian(kAllCut);
    CHECK((projected - exact).norm() > 1e-3 * exact.norm());
    CHECK_NEAR(problem.hessian(0.25), MatrixX(0.75 * exact + 0.25 * projected), kRounding * exact.norm());
}

TEST(a_flat_sheet_under_tension_needs_no_projection) {
    Problem problem = at_rest(build(fixtures::grid(3, 3, 0.5)), {0.1, kStretch, kShear, kBend, kDamping});
    problem.x = mapped(problem.cloth.rest, Vec3(1.1, 1.2, 1.0).asDiagonal());
    CHECK(problem.hessian(kAllCut) == problem.hessian(kNothingCut));
}

// --- backward --------------------------------------------------------------------------------------------------------

TEST(elastic_backward_agrees_with_differences) {
    check::Random random(10);
    const double scale = 0.7;
    for (int k = 0; k < 5; ++k) {
        const Problem problem = random_problem(random, Term::all);
        const Nodes direction = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
        const VectorX z = flatten_nodes(direction);
        const auto s = [&](const Problem& at) { return z.dot(flatten_nodes(at.gradient(scale))); };

        const Nodes before = shaken(problem.x, random, 1.0);
        Nodes sum = before;
        const ClothParameters grad = add_elastic_backward(
            problem.cloth, problem.parameters, kDt, problem.start(), problem.x.data(), problem.x_start.data(),
            direction.data(), scale, sum.data());
        const VectorX grad_x_start = flatten_nodes(sum) - flatten_nodes(before);
        const auto by_x_start = [&](const VectorX& x_start) {
            Problem moved_start = problem;
            moved_start.x_start = unflatten_nodes(x_start);
            return s(moved_start);
        };
        CHECK(grad_x_start.norm() > 1e-2);
        CHECK_NEAR(
            grad_x_start, fixtures::numeric_gradient(by_x_start, flatten_nodes(problem.x_start), 1e-4),
            1e-8 * grad_x_start.norm());

        CHECK(grad.density == 0.0);
        const std::pair<double ClothParameters::*, double> fields[] = {
            {&ClothParameters::stretch, grad.stretch},
            {&ClothParameters::shear, grad.shear},
            {&ClothParameters::bend, grad.bend},
            {&ClothParameters::damping, grad.damping}};
        for (const auto& [field, analytic] : fields) {
            const auto by_field = [&, member = field](const VectorX& value) {
                Problem changed = problem;
                changed.parameters.*member = value[0];
                return s(changed);
            };
            const VectorX numeric =
                fixtures::numeric_gradient(by_field, VectorX::Constant(1, problem.parameters.*field), 1e-3);
            CHECK(std::abs(analytic) > 1e-3);
            CHECK_NEAR(analytic, numeric[0], 1e-9 * (1.0 + std::abs(analytic)));  // s is linear in each
        }
    }
}

TEST(undamped_steps_still_know_their_gradient_by_damping) {
    check::Random random(11);
    const Problem problem = random_problem(random, Term::all_undamped);
    const Nodes direction = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
    Nodes grad_x_start(problem.x.size(), Vec3::Zero());
    const ClothParameters grad = add_elastic_backward(
        problem.cloth, problem.parameters, kDt, problem.start(), problem.x.data(), problem.x_start.data(),
        direction.data(), 1.0, grad_x_start.data());
    CHECK(largest(grad_x_start) == 0.0);
    const auto s = [&](double damping) {
        Problem changed = problem;
        changed.parameters.damping = damping;
        return flatten_nodes(direction).dot(flatten_nodes(changed.gradient()));
    };
    CHECK(std::abs(grad.damping) > 1e-3);
    CHECK_NEAR(grad.damping, s(1.0) - s(0.0), 1e-10 * std::abs(grad.damping));
}

// --- degenerate shapes -----------------------------------------------------------------------------------------------

TEST(collapsed_sheets_have_finite_forces) {
    const Cloth cloth = build(fixtures::grid(3, 3, 0.5), {1, 0.2, 0}, 0.2);
    const Problem rest = at_rest(cloth, {0.1, kStretch, kShear, kBend, kDamping});
    const std::vector<Mat3> maps = {
        Mat3::Zero(), Vec3(1, 0, 0).asDiagonal(), Vec3(0, 1, 0).asDiagonal(), Vec3(1, 1e-8, 0).asDiagonal(),
        Vec3(1e-30, 1e-30, 0).asDiagonal()};
    for (const Mat3& map : maps) {
        NOTE(map);
        for (const bool at_start : {false, true}) {
            Problem problem = rest;
            (at_start ? problem.x_start : problem.x) = mapped(cloth.rest, map);
            CHECK(std::isfinite(problem.energy()));
            CHECK(flatten_nodes(problem.gradient()).allFinite());
            CHECK(problem.hessian(kNothingCut).allFinite());
            CHECK(problem.hessian(kAllCut).allFinite());
            CHECK(flatten_nodes(problem.hessian_product(cloth.rest)).allFinite());
            Nodes grad_x_start(cloth.rest.size(), Vec3::Zero());
            const ClothParameters grad = add_elastic_backward(
                cloth, problem.parameters, kDt, problem.start(), problem.x.data(), problem.x_start.data(),
                cloth.rest.data(), 1.0, grad_x_start.data());
            CHECK(flatten_nodes(grad_x_start).allFinite());
            CHECK(std::isfinite(grad.stretch + grad.shear + grad.bend + grad.damping));
        }
    }
}

TEST(a_collapsed_hinge_contributes_nothing) {
    Problem problem = at_rest(build(fixtures::folded_pair(0.5)), {0.1, 0.0, 0.0, kBend, kDamping});
    problem.x = fixtures::folded_pair(-0.5).vertices;
    CHECK(problem.energy() > 1e-2);
    problem.x[2] = Vec3(0.4, 0.0, 0.0);
    CHECK(problem.energy() == 0.0);
    CHECK(largest(problem.gradient()) == 0.0);
    CHECK(problem.hessian(kNothingCut).isZero(0.0));
}

}  // namespace test_cloth_elasticity_derivatives
