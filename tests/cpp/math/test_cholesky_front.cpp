#include "math/cholesky_front.hpp"

#include <Eigen/Cholesky>
#include <cstring>
#include <limits>

#include "check.hpp"
#include "math/types.hpp"

namespace test_cholesky_front {

using namespace diffsim;

namespace {

constexpr double kRounding = 1e-12;  // condition numbers below 1e3

/// A front, eliminated, with its two solves.
struct Result {
    bool success;
    VectorX factor, inverse, x, x_transposed;
    MatrixX update;
};

Result eliminate(const CholeskyKernels& kernels, int width, const MatrixX& panel_in, const VectorX& rhs) {
    const int rows = static_cast<int>(panel_in.rows());
    MatrixX panel = panel_in;
    Result result;
    result.factor = VectorX::Zero(rows * width);
    result.inverse = VectorX::Zero(width);
    result.update = MatrixX::Zero(rows - width, rows - width);
    result.success = kernels.factorize(
        {width, rows - width, panel.data(), result.factor.data(), result.inverse.data(), result.update.data()});
    result.x = result.x_transposed = rhs;
    VectorX partials(kCholeskyTile * width);
    kernels.solve(result.factor.data(), result.inverse.data(), width, rows, result.x.data());
    kernels.solve_transposed(
        result.factor.data(), result.inverse.data(), width, rows, result.x_transposed.data(), partials.data());
    return result;
}

template <class Matrix>
bool same_bits(const Matrix& a, const Matrix& b) {
    return a.size() == 0 || std::memcmp(a.data(), b.data(), sizeof(double) * static_cast<std::size_t>(a.size())) == 0;
}

}  // namespace

TEST(cholesky_front_agrees_with_eigen_and_between_processors) {
    check::Random random(1);
    for (const int width : {4, 8, 32, 36, 64, 100}) {
        for (const int below : {0, 4, 28, 36, 120}) {
            NOTE(width);
            NOTE(below);
            const int rows = width + below;
            const MatrixX root = random.matrix(rows, rows);
            const MatrixX matrix = root * root.transpose() / rows + MatrixX::Identity(rows, rows);
            const VectorX rhs = random.vector(rows);
            const Result portable = eliminate(portable_cholesky_kernels(), width, matrix.leftCols(width), rhs);
            CHECK(portable.success);

            const MatrixX l_a = matrix.topLeftCorner(width, width).llt().matrixL();
            MatrixX l_b(below, width);
            if (below > 0)
                l_b = l_a.triangularView<Eigen::Lower>().solve(matrix.topRightCorner(width, below)).transpose();
            MatrixX l(rows, width);
            l.topRows(width) = l_a;
            l.bottomRows(below) = l_b;
            for (int c = 0; c < width; ++c) {
                CHECK_NEAR(portable.inverse[c], 1.0 / l(c, c), kRounding);
                for (int r = c; r < rows; ++r)
                    CHECK_NEAR(portable.factor[r / 4 * 4 * width + 4 * c + r % 4], l(r, c), kRounding);
            }
            const MatrixX difference = portable.update + l_b * l_b.transpose();
            CHECK_NEAR(MatrixX(difference.triangularView<Eigen::Lower>()), MatrixX::Zero(below, below), kRounding);

            VectorX x = rhs, x_transposed = rhs;
            x.head(width) = l_a.triangularView<Eigen::Lower>().solve(rhs.head(width));
            x.tail(below) -= l_b * x.head(width);
            x_transposed.head(width) = l_a.transpose().triangularView<Eigen::Upper>().solve(
                rhs.head(width) - l_b.transpose() * rhs.tail(below));
            CHECK_NEAR(portable.x, x, kRounding);
            CHECK_NEAR(portable.x_transposed, x_transposed, kRounding);

            const Result fastest = eliminate(cholesky_kernels(), width, matrix.leftCols(width), rhs);
            CHECK(fastest.success);
            CHECK(same_bits(fastest.factor, portable.factor));
            CHECK(same_bits(fastest.inverse, portable.inverse));
            CHECK(same_bits(fastest.update, portable.update));
            CHECK(same_bits(fastest.x, portable.x));
            CHECK(same_bits(fastest.x_transposed, portable.x_transposed));
        }
    }
}

TEST(cholesky_front_refuses_a_pivot_that_is_not_positive) {
    for (const double pivot : {0.0, -1.0, kInfinity, std::numeric_limits<double>::quiet_NaN()}) {
        for (int place = 0; place < 40; ++place) {
            NOTE(pivot);
            NOTE(place);
            MatrixX panel = MatrixX::Identity(48, 40);
            panel(place, place) = pivot;
            CHECK(!eliminate(cholesky_kernels(), 40, panel, VectorX::Zero(48)).success);
            CHECK(!eliminate(portable_cholesky_kernels(), 40, panel, VectorX::Zero(48)).success);
        }
    }
}

}  // namespace test_cholesky_front
