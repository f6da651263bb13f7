#include <Eigen/Cholesky>
#include <cmath>

#include "check.hpp"
#include "math/small_cholesky.hpp"

namespace test_small_cholesky {

using namespace diffsim;

TEST(small_cholesky_agrees_with_a_library) {
    check::Random random(1);
    for (int k = 0; k < 50; ++k) {
        NOTE(k);
        Mat6 root;
        for (int j = 0; j < 6; ++j) root.col(j) = random.vector(6);
        const Mat6 A = root * root.transpose() + 0.1 * Mat6::Identity();
        const Vec6 b = random.vector(6), expected = A.llt().solve(b);
        SmallCholesky<6> factor;
        CHECK(factor.factorize(A));
        Vec6 x = b;
        factor.solve_in_place(x);
        CHECK_NEAR(x, expected, 1e-11 * expected.norm());

        Mat6 upper_spoiled = A;
        upper_spoiled(0, 5) = 1e9;  // only the lower half counts
        SmallCholesky<6> same;
        CHECK(same.factorize(upper_spoiled));
        Vec6 y = b;
        same.solve_in_place(y);
        CHECK(x == y);
    }
}

TEST(small_cholesky_refuses_what_is_not_positive_definite) {
    SmallCholesky<6> factor;
    for (int k = 0; k < 6; ++k) {
        NOTE(k);
        for (const double pivot : {0.0, -1.0, std::nan("")}) {
            Mat6 A = Mat6::Identity();
            A(k, k) = pivot;
            CHECK(!factor.factorize(A));
        }
    }
}

}  // namespace test_small_cholesky
