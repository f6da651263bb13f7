// The harness itself: each kind of check passes on what is right and fails, saying why, on what is wrong.
#include "check.hpp"

#include <limits>

namespace test_check {

namespace {

enum class Colour { red, green };

/// The message of the check that fails in `body`; empty when none does.
std::string failure_of(const std::function<void()>& body) {
    try {
        body();
    } catch (const check::Failure& failure) {
        return failure.what();
    }
    return "";
}

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

double cubic(const Eigen::VectorXd& x) { return x.array().cube().sum(); }

void throw_error() { throw std::invalid_argument("mass of body 'cube' must be positive, got -1"); }

}  // namespace

TEST(check_passes_on_what_holds) {
    const std::vector<int> three(3);
    CHECK(1 + 1 == 2);
    CHECK(three.size() == 3);
    CHECK(!three.empty() && three[0] == 0);
    CHECK(Colour::red != Colour::green);
    CHECK(Eigen::Vector2d(1, 2) == Eigen::Vector2d(1, 2));
}

TEST(check_fails_with_place_expression_and_values) {
    const double toi = 0.75;
    const std::string failure = failure_of([&] { CHECK(toi <= 0.5); });
    CHECK(contains(failure, "test_check.cpp:"));
    CHECK(contains(failure, "CHECK(toi <= 0.5)"));
    CHECK(contains(failure, "0.75 <= 0.5"));
    CHECK(!failure_of([] { CHECK(false); }).empty());
    CHECK(!failure_of([] { CHECK(Colour::red == Colour::green); }).empty());
    CHECK(!failure_of([] { CHECK(true && 1 > 2); }).empty());
}

TEST(check_near_bounds_scalars_and_matrices) {
    CHECK_NEAR(1.0, 1.0 + 1e-9, 1e-8);
    CHECK_NEAR(Eigen::Vector3d(0, 0, 1), Eigen::Vector3d::UnitZ(), 0.0);
    CHECK(!failure_of([] { CHECK_NEAR(1.0, 1.1, 0.01); }).empty());
    CHECK(!failure_of([] { CHECK_NEAR(std::numeric_limits<double>::quiet_NaN(), 0.0, 1e300); }).empty());
    CHECK(contains(failure_of([] { CHECK_NEAR(Eigen::Vector3d(0, 0, 1), Eigen::Vector3d::Zero(), 0.5); }), "(2, 0)"));
    CHECK(contains(failure_of([] { CHECK_NEAR(Eigen::VectorXd::Zero(2), Eigen::VectorXd::Zero(3), 0.5); }), "shape"));
}

TEST(check_throws_wants_the_type_and_the_message) {
    CHECK_THROWS(throw_error(), std::invalid_argument);
    CHECK_THROWS_WITH(throw_error(), std::invalid_argument, "body 'cube'");
    CHECK(contains(failure_of([] { CHECK_THROWS(static_cast<void>(0), std::exception); }), "did not throw"));
    CHECK(contains(failure_of([] { CHECK_THROWS(throw_error(), std::domain_error); }), "another type"));
    CHECK(contains(failure_of([] { CHECK_THROWS_WITH(throw_error(), std::exception, "inertia"); }), "inertia"));
}

TEST(check_gradient_rejects_wrong_and_vanishing_gradients) {
    const Eigen::VectorXd x = check::Random(3).vector(5, 0.5, 1.5);
    const Eigen::VectorXd grad_x = 3.0 * x.array().square();
    CHECK_GRADIENT(cubic, x, grad_x);
    CHECK_GRADIENT(cubic, x, grad_x, {1e-5, 1e-6, 20});

    Eigen::VectorXd wrong = grad_x;
    wrong[4] += 1e-4;
    CHECK(contains(failure_of([&] { CHECK_GRADIENT(cubic, x, wrong); }), "analytic"));
    const Eigen::VectorXd zero = Eigen::VectorXd::Zero(5);
    const auto constant = [](const Eigen::VectorXd&) { return 1.0; };
    CHECK(contains(failure_of([&] { CHECK_GRADIENT(constant, x, zero); }), "norm of the gradient is 0"));
}

TEST(notes_are_printed_while_in_scope) {
    const std::string failure = failure_of([] {
        for (int seed = 0; seed < 3; ++seed) {
            NOTE(seed);
            CHECK(seed < 2);
        }
    });
    CHECK(contains(failure, "seed = 2"));
    CHECK(!contains(failure, "seed = 1"));
    CHECK(!contains(failure_of([] { CHECK(false); }), "seed"));
}

TEST(random_numbers_are_seeded_and_in_range) {
    const Eigen::VectorXd a = check::Random(7).vector(1000, 2.0, 3.0);
    CHECK(a == check::Random(7).vector(1000, 2.0, 3.0));
    CHECK(a != check::Random(8).vector(1000, 2.0, 3.0));
    CHECK(a.minCoeff() >= 2.0);
    CHECK(a.maxCoeff() < 3.0);
    CHECK_NEAR(a.mean(), 2.5, 0.05);  // five standard errors, 5 / sqrt(12 · 1000)
}

}  // namespace test_check
