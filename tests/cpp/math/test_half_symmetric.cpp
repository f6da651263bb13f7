#include "math/half_symmetric.hpp"

#include "check.hpp"

namespace test_half_symmetric {

using namespace diffsim;

namespace {

/// Everything there is to add, once as it is and once to a plain matrix.
template <int N>
void check_sums(check::Random& random) {
    static_assert(N >= 6);
    HalfSymmetric<N> sum;
    MatrixX plain = MatrixX::Zero(N, N);
    for (int k = 0; k < 5; ++k) {
        const VectorX row = random.vector(N), column = random.vector(N);
        const Vec3 part = random.vector(3);
        const Mat3 block = random.matrix(3, 3);
        const double factor = random.uniform(-1.0, 1.0);
        sum.add_square(factor, Vector<N>(row));
        plain += factor * row * row.transpose();
        sum.template add_outer<3, 3>(Vector<N>(column), part);
        VectorX full = VectorX::Zero(N);
        full.segment<3>(3) = part;
        plain += column * full.transpose() + full * column.transpose();
        sum.template block<3, 3>(0, N - 3) += block;
        plain.topRightCorner<3, 3>() += block;
        plain.bottomLeftCorner<3, 3>() += block.transpose();
    }
    CHECK(plain.norm() > 1.0);
    CHECK_NEAR(MatrixX(sum.whole()), plain, 1e-14);
    sum.set_zero();
    CHECK(sum.whole().isZero(0.0));
}

}  // namespace

TEST(sums_of_symmetric_matrices_are_those_of_whole_ones) {
    check::Random random(1);
    check_sums<6>(random);
    check_sums<9>(random);
    check_sums<12>(random);
    check_sums<15>(random);
    check_sums<18>(random);
}

}  // namespace test_half_symmetric
