#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "zone/zone.hpp"

/// Linear systems of a zone that are not symmetric.
namespace diffsim {

/// aᵀ M b
double mass_dot(const Zone& zone, const Coordinates& a, const Coordinates& b);

/// Solve A x = b by GMRES, `apply(x)` giving A x: meant for A near the unit matrix, as a preconditioner leaves it. `x`
/// holds b, and receives the solution; add, scale and count are known of vectors like it, `product(a, b)` is their
/// inner product. Returns the residual that is left, relative to b.
template <class Vector, class Apply, class Product>
double gmres(const Apply& apply, const Product& product, double tolerance, int max_iterations, Vector& x) {
    const double size = std::sqrt(product(x, x));
    if (!(size > 0.0)) return 0.0;
    std::vector<Vector> basis(1, x);
    scale(1.0 / size, basis[0]);
    max_iterations = std::min(max_iterations, count(x));
    // Hessenberg matrix, turned to upper triangular form by Givens rotations column by column.
    MatrixX R = MatrixX::Zero(max_iterations + 1, max_iterations);
    VectorX rhs = VectorX::Zero(max_iterations + 1);
    rhs[0] = size;
    std::vector<std::pair<double, double>> turns;
    int done = 0;
    while (done < max_iterations && std::abs(rhs[done]) > tolerance * size) {
        Vector next = apply(basis[static_cast<std::size_t>(done)]);
        double before = std::sqrt(product(next, next)), left = before;
        for (int pass = 0; pass < 2 && (pass == 0 || left < 0.5 * before); ++pass) {  // again where digits were lost
            before = left;
            for (int k = 0; k <= done; ++k) {
                const Vector& known = basis[static_cast<std::size_t>(k)];
                const double part = product(known, next);
                R(k, done) += part;
                add(-part, known, next);
            }
            left = std::sqrt(product(next, next));
        }
        double below = left;
        for (int k = 0; k < done; ++k) {
            const auto [c, s] = turns[static_cast<std::size_t>(k)];
            const double upper = R(k, done), lower = R(k + 1, done);
            R(k, done) = c * upper + s * lower;
            R(k + 1, done) = c * lower - s * upper;
        }
        const double length = std::hypot(R(done, done), below);
        if (!(length > 0.0) || !std::isfinite(length)) break;
        const double c = R(done, done) / length, s = below / length;
        turns.emplace_back(c, s);
        R(done, done) = length;
        rhs[done + 1] = -s * rhs[done];
        rhs[done] *= c;
        ++done;
        if (left <= 1e-14 * length) break;
        scale(1.0 / left, next);
        basis.push_back(std::move(next));
    }
    const VectorX weights = R.topLeftCorner(done, done).template triangularView<Eigen::Upper>().solve(rhs.head(done));
    scale(0.0, x);
    for (int k = 0; k < done; ++k) add(weights[k], basis[static_cast<std::size_t>(k)], x);
    return std::abs(rhs[done]) / size;
}

}  // namespace diffsim
