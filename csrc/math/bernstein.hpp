#pragma once

#include <algorithm>
#include <array>
#include <cstddef>
#include <type_traits>

/// Polynomials on [0, 1] by their Bernstein coefficients: every value is a weighted mean of them, the first and the
/// last are the values at the ends. An array of n coefficients is a polynomial of degree n - 1.
namespace diffsim {

namespace detail {

constexpr double binomial(std::size_t n, std::size_t k) {
    double value = 1.0;
    for (std::size_t i = 1; i <= k; ++i) value = value * static_cast<double>(n - k + i) / static_cast<double>(i);
    return value;
}

/// C(m, i) C(n, j) / C(m + n, i + j) for the coefficients i, j of polynomials of degrees m, n.
template <std::size_t M, std::size_t N>
constexpr std::array<std::array<double, N>, M> product_weights() {
    std::array<std::array<double, N>, M> weights{};
    for (std::size_t i = 0; i < M; ++i)
        for (std::size_t j = 0; j < N; ++j)
            weights[i][j] = binomial(M - 1, i) * binomial(N - 1, j) / binomial(M + N - 2, i + j);
    return weights;
}

}  // namespace detail

/// The product of two polynomials; `times(f_i, g_j)` multiplies two of their coefficients.
template <typename T, typename U, std::size_t M, std::size_t N, typename Times>
auto bernstein_product(const std::array<T, M>& f, const std::array<U, N>& g, const Times& times) {
    constexpr auto weights = detail::product_weights<M, N>();
    std::array<std::decay_t<decltype(times(f[0], g[0]))>, M + N - 1> product;
    for (std::size_t i = 0; i < M; ++i) {
        for (std::size_t j = 0; j < N; ++j) {
            if (i == 0 || j == N - 1)
                product[i + j] = weights[i][j] * times(f[i], g[j]);
            else
                product[i + j] += weights[i][j] * times(f[i], g[j]);
        }
    }
    return product;
}

/// The same polynomial with the coefficients of a higher degree.
template <std::size_t N, std::size_t M>
std::array<double, N> raised(const std::array<double, M>& f) {
    static_assert(N >= M);
    std::array<double, N - M + 1> one;
    one.fill(1.0);
    return bernstein_product(f, one, [](double a, double b) { return a * b; });
}

/// A time in [0, 1] up to which the polynomial is not negative for sure: there the convex hull of its control points
/// first comes down to zero. 0 where it starts at zero or below.
template <std::size_t N>
double positive_until(const std::array<double, N>& f) {
    if (!(f[0] > 0.0)) return 0.0;
    double reach = static_cast<double>(N - 1);
    for (std::size_t k = 1; k < N; ++k) {
        if (f[k] >= 0.0) continue;
        for (std::size_t j = 0; j < k; ++j)
            if (f[j] >= 0.0)
                reach = std::min(reach, static_cast<double>(j) + static_cast<double>(k - j) * (f[j] / (f[j] - f[k])));
    }
    return reach / static_cast<double>(N - 1);
}

}  // namespace diffsim
