#include "math/bernstein.hpp"

#include <cmath>

#include "check.hpp"

namespace test_bernstein {

using namespace diffsim;

namespace {

constexpr double kRounding = 1e-14;

template <std::size_t N>
double value(const std::array<double, N>& f, double x) {
    double sum = 0.0;
    for (std::size_t k = 0; k < N; ++k)
        sum += detail::binomial(N - 1, k) * std::pow(x, double(k)) * std::pow(1.0 - x, double(N - 1 - k)) * f[k];
    return sum;
}

template <std::size_t N>
std::array<double, N> random_coefficients(check::Random& random) {
    std::array<double, N> f;
    for (double& coefficient : f) coefficient = random.uniform(-1.0, 1.0);
    return f;
}

}  // namespace

TEST(products_and_raised_degrees_have_the_values_they_should) {
    check::Random random(31);
    for (int k = 0; k < 50; ++k) {
        const auto f = random_coefficients<4>(random);
        const auto g = random_coefficients<3>(random);
        const auto product = bernstein_product(f, g, [](double a, double b) { return a * b; });
        const auto same = raised<7>(f);
        for (const double x : {0.0, 0.1, 0.5, 0.9, 1.0}) {
            CHECK_NEAR(value(product, x), value(f, x) * value(g, x), kRounding);
            CHECK_NEAR(value(same, x), value(f, x), kRounding);
        }
    }
}

TEST(a_polynomial_is_positive_for_as_long_as_it_says) {
    check::Random random(32);
    int part = 0, all = 0;
    for (int k = 0; k < 2000; ++k) {
        auto f = random_coefficients<5>(random);
        f[0] = std::abs(f[0]) + 1e-3;
        const double until = positive_until(f);
        CHECK((until > 0.0 && until <= 1.0));
        for (int s = 0; s <= 100; ++s) CHECK(value(f, until * s / 100) >= -kRounding);
        (until < 1.0 ? part : all) += 1;
    }
    CHECK((part >= 100 && all >= 100));
    CHECK(positive_until(std::array<double, 2>{1.0, -3.0}) == 0.25);  // of a line it is exact
    CHECK(positive_until(std::array<double, 3>{0.0, 1.0, 1.0}) == 0.0);
}

}  // namespace test_bernstein
