#include <Eigen/Eigenvalues>

#include "check.hpp"
#include "math/positive_part.hpp"

namespace test_positive_part {

using namespace diffsim;

namespace {

/// S = A - B with A, B positive semidefinite on spaces normal to each other: A is the positive part.
template <int N>
void check_size() {
    using Matrix = Eigen::Matrix<double, N, N>;
    check::Random random(N);
    Matrix any;
    for (int j = 0; j < N; ++j) any.col(j) = random.vector(N);
    const Matrix axes = Eigen::SelfAdjointEigenSolver<MatrixX>(any + any.transpose()).eigenvectors();
    Matrix A = Matrix::Zero(), B = Matrix::Zero();
    for (int k = 0; k < N; ++k) {
        const Matrix part = random.uniform(0.1, 3.0) * axes.col(k) * axes.col(k).transpose();
        (k % 3 == 0 ? B : A) += part;
    }
    const Matrix S = A - B;
    CHECK_NEAR(positive_part<N>(S), A, 1e-13);
    CHECK_NEAR(positive_part<N>(A), A, 1e-13);
    CHECK_NEAR(positive_part<N>(-A), Matrix(Matrix::Zero()), 1e-13);
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
