#pragma once

#include <cmath>
#include <vector>

#include "zone/zone.hpp"

/// Linear systems of a zone that are not symmetric.
namespace diffsim {

/// aᵀ M b
double mass_dot(const Zone& zone, const Coordinates& a, const Coordinates& b);

/// Solve A x = b by GMRES, `apply(x)` giving A x: meant for A near the unit matrix, as a preconditioner leaves it. Norms are
/// those of the mass. `x` holds b, and receives the solution. Returns the residual that is left, relative to b.
template <class Apply>
double gmres(const Zone& zone, const Apply& apply, double tolerance, int max_iterations, Coordinates& x) {
    const double size = std::sqrt(mass_dot(zone, x, x));
    if (!(size > 0.0)) return 0.0;
    std::vector<Coordinates> basis(1, x);
    scale(1.0 / size, basis[0]);
    // Hessenberg matrix, turned to upper triangular form by Givens rotations column by column.
    MatrixX R = MatrixX::Zero(max_iterations + 1, max_iterations);
    VectorX rhs = VectorX::Zero(max_iterations + 1);
    rhs[0] = size;
    std::vector<std::pair<double, double>> turns;
    int count = 0;
    while (count < max_iterations && std::abs(rhs[count]) > tolerance * size) {
        Coordinates next = apply(basis[static_cast<std::size_t>(count)]);
        for (int pass = 0; pass < 2; ++pass) {
            for (int k = 0; k <= count; ++k) {
                const Coordinates& known = basis[static_cast<std::size_t>(k)];
                const double part = mass_dot(zone, known, next);
                R(k, count) += part;
                add(-part, known, next);
            }
        }
        const double left = std::sqrt(mass_dot(zone, next, next));
        double below = left;
        for (int k = 0; k < count; ++k) {
            const auto [c, s] = turns[static_cast<std::size_t>(k)];
            const double upper = R(k, count), lower = R(k + 1, count);
            R(k, count) = c * upper + s * lower;
            R(k + 1, count) = c * lower - s * upper;
        }
        const double length = std::hypot(R(count, count), below);
        if (!(length > 0.0) || !std::isfinite(length)) break;
        const double c = R(count, count) / length, s = below / length;
        turns.emplace_back(c, s);
        R(count, count) = length;
        rhs[count + 1] = -s * rhs[count];
        rhs[count] *= c;
        ++count;
        if (left <= 1e-14 * length) break;
        scale(1.0 / left, next);
        basis.push_back(std::move(next));
    }
    const VectorX weights =
        R.topLeftCorner(count, count).template triangularView<Eigen::Upper>().solve(rhs.head(count));
    x.assign_zero(x.bodies.size(), x.nodes.size());
    for (int k = 0; k < count; ++k) add(weights[k], basis[static_cast<std::size_t>(k)], x);
    return std::abs(rhs[count]) / size;
}

}  // namespace diffsim
