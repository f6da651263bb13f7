#include "zone/gmres.hpp"

#include <Eigen/LU>

#include "fixtures.hpp"

namespace test_gmres {

using namespace diffsim;

TEST(gmres_solves_systems_that_are_not_symmetric) {
    check::Random random(3);
    Zone zone;
    for (int i = 0; i < 3; ++i)
        zone.bodies.push_back(fixtures::zone_body(i, Pose(), 1.0 + i, fixtures::random_inertia(random, 4.0)));
    zone.dynamic_count = 3;
    const MatrixX A = MatrixX::Identity(18, 18) + 0.3 * random.matrix(18, 18);
    const auto flat = [](const Coordinates& c) {
        VectorX v(18);
        for (int i = 0; i < 3; ++i) v.segment<6>(6 * i) = c.bodies[static_cast<std::size_t>(i)];
        return v;
    };
    const auto coordinates = [](const VectorX& v) {
        Coordinates c;
        c.assign_zero(3, 0);
        for (int i = 0; i < 3; ++i) c.bodies[static_cast<std::size_t>(i)] = v.segment<6>(6 * i);
        return c;
    };
    const VectorX b = random.matrix(18, 1);
    Coordinates x = coordinates(b);
    const auto product = [&](const Coordinates& p, const Coordinates& q) { return mass_dot(zone, p, q); };
    const double left = gmres([&](const Coordinates& p) { return coordinates(A * flat(p)); }, product, 1e-13, 30, x);
    CHECK(left <= 1e-12);
    CHECK_NEAR(flat(x), VectorX(A.partialPivLu().solve(b)), 1e-10);
    // A right-hand side of zero is its own solution, and of the unit matrix one iteration is enough.
    Coordinates zero = coordinates(VectorX::Zero(18));
    CHECK(gmres([](const Coordinates& p) { return p; }, product, 1e-13, 30, zero) == 0.0);
    CHECK(flat(zero).norm() == 0.0);
    Coordinates same = coordinates(b);
    CHECK(gmres([](const Coordinates& p) { return p; }, product, 1e-13, 1, same) <= 1e-14);
    CHECK_NEAR(flat(same), b, 1e-14);
}

}  // namespace test_gmres
