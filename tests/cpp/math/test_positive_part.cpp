#include <Eigen/Eigenvalues>

#include "check.hpp"
#include "math/positive_part.hpp"

namespace test_positive_part {

using namespace diffsim;

namespace {

/// S = A - B with A, B positive semidefinite on spaces normal to each other: A is the positive part. Only what is
/// tested has a fixed size: five of each would take the compiler longest of all.
template <int N>
void check_size() {
    using Matrix = Eigen::Matrix<double, N, N>;
    check::Random random(N);
    const MatrixX any = random.matrix(N, N);
    const MatrixX axes = Eigen::SelfAdjointEigenSolver<MatrixX>(any + any.transpose()).eigenvectors();
    MatrixX A = MatrixX::Zero(N, N), B = A;
    for (int k = 0; k < N; ++k) {
        const MatrixX part = random.uniform(0.1, 3.0) * axes.col(k) * axes.col(k).transpose();
        (k % 3 == 0 ? B : A) += part;
    }
    const auto positive = [](const MatrixX& matrix) { return MatrixX(positive_part<N>(Matrix(matrix))); };
    CHECK_NEAR(positive(A - B), A, 1e-13);
    CHECK_NEAR(positive(A), A, 1e-13);
    CHECK_NEAR(positive(-A), MatrixX(MatrixX::Zero(N, N)), 1e-13);
}

}  // namespace

TEST(positive_part_keeps_positive_eigenvalues_and_drops_the_others) {
    check_size<3>();
    check_size<6>();
    check_size<9>();
    check_size<15>();
    check_size<18>();
}

}  // namespace test_positive_part
