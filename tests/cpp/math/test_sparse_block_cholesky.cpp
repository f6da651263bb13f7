#include "math/sparse_block_cholesky.hpp"

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cstring>
#include <limits>
#include <set>
#include <utility>
#include <vector>

#include "check.hpp"
#include "math/types.hpp"

namespace test_sparse_block_cholesky {

using namespace diffsim;
using Pairs = std::vector<std::pair<int, int>>;

namespace {

constexpr double kRounding = 1e-11;  // of the solution's largest entry; condition numbers below 1e4

/// A block matrix with storage of its own.
struct System {
    std::vector<int> sizes;
    Pairs pairs;
    std::vector<MatrixX> diagonal, upper;

    std::vector<const double*> diagonal_data() const { return data(diagonal); }
    std::vector<const double*> upper_data() const { return data(upper); }

    std::vector<int> starts() const {
        std::vector<int> result{0};
        for (const int size : sizes) result.push_back(result.back() + size);
        return result;
    }
    MatrixX dense() const {
        const std::vector<int> start = starts();
        MatrixX result = MatrixX::Zero(start.back(), start.back());
        for (std::size_t i = 0; i < sizes.size(); ++i) {
            result.block(start[i], start[i], sizes[i], sizes[i]) =
                diagonal[i].selfadjointView<Eigen::Lower>().toDenseMatrix();
        }
        for (std::size_t k = 0; k < pairs.size(); ++k) {
            const auto [i, j] = pairs[k];
            result.block(start[i], start[j], sizes[i], sizes[j]) = upper[k];
            result.block(start[j], start[i], sizes[j], sizes[i]) = upper[k].transpose();
        }
        return result;
    }

private:
    static std::vector<const double*> data(const std::vector<MatrixX>& blocks) {
        std::vector<const double*> result;
        for (const MatrixX& block : blocks) result.push_back(block.data());
        return result;
    }
};

/// Σ over pairs of a random Gram matrix of both blocks, plus the identity.
void fill(System& system, check::Random& random) {
    system.diagonal.clear();
    system.upper.clear();
    for (const int size : system.sizes) system.diagonal.push_back(MatrixX::Identity(size, size));
    for (const auto& [i, j] : system.pairs) {
        const int a = system.sizes[i], b = system.sizes[j];
        const MatrixX rows = random.matrix(a + b, a + b), gram = rows * rows.transpose();
        system.diagonal[i] += gram.topLeftCorner(a, a);
        system.diagonal[j] += gram.bottomRightCorner(b, b);
        system.upper.push_back(gram.topRightCorner(a, b));
    }
}

System make_system(std::vector<int> sizes, Pairs pairs, check::Random& random) {
    System system{std::move(sizes), std::move(pairs), {}, {}};
    fill(system, random);
    return system;
}

bool factorize(SparseBlockCholesky& cholesky, const System& system) {
    return cholesky.factorize(system.diagonal_data().data(), system.upper_data().data());
}

VectorX solve(const SparseBlockCholesky& cholesky, const VectorX& rhs) {
    VectorX x = rhs;
    cholesky.solve_in_place(x.data());
    return x;
}

/// Factorizes and compares with a dense factorization. Returns the solution.
VectorX check_solution(SparseBlockCholesky& cholesky, const System& system, check::Random& random) {
    const MatrixX matrix = system.dense();
    const VectorX rhs = random.vector(matrix.rows());
    CHECK(cholesky.rows() == matrix.rows());
    CHECK(factorize(cholesky, system));
    const VectorX x = solve(cholesky, rhs), expected = matrix.llt().solve(rhs);
    CHECK_NEAR(x, expected, kRounding * expected.lpNorm<Eigen::Infinity>());
    return x;
}

bool same_bits(const VectorX& a, const VectorX& b) {
    return a.size() == b.size() && std::memcmp(a.data(), b.data(), sizeof(double) * a.size()) == 0;
}

/// Each pair with the given probability.
Pairs random_pairs(check::Random& random, int count, double probability) {
    Pairs pairs;
    for (int i = 0; i < count; ++i)
        for (int j = i + 1; j < count; ++j)
            if (random.uniform(0.0, 1.0) < probability) pairs.emplace_back(i, j);
    return pairs;
}

std::vector<int> random_sizes(check::Random& random, int count, const std::vector<int>& choice) {
    std::vector<int> sizes;
    for (int i = 0; i < count; ++i)
        sizes.push_back(
            choice[static_cast<std::size_t>(random.uniform(0.0, 1.0) * static_cast<double>(choice.size()))]);
    return sizes;
}

/// n x n nodes; each is paired with all nodes at most two rows and two columns away.
Pairs sheet_pairs(int n) {
    Pairs pairs;
    for (int a = 0; a < n * n; ++a)
        for (int b = a + 1; b < n * n; ++b)
            if (b / n - a / n <= 2 && std::abs(b % n - a % n) <= 2) pairs.emplace_back(a, b);
    return pairs;
}

/// n x n x n blocks; each is paired with the next in each direction.
Pairs heap_pairs(int n) {
    Pairs pairs;
    const auto apart = [n](int a, int b, int stride) { return std::abs(a / stride % n - b / stride % n); };
    for (int a = 0; a < n * n * n; ++a)
        for (int b = a + 1; b < n * n * n; ++b)
            if (apart(a, b, 1) + apart(a, b, n) + apart(a, b, n * n) == 1) pairs.emplace_back(a, b);
    return pairs;
}

Pairs chain_pairs(int count) {
    Pairs pairs;
    for (int i = 0; i + 1 < count; ++i) pairs.emplace_back(i, i + 1);
    return pairs;
}

/// The block `hub` with all others.
Pairs star_pairs(int count, int hub) {
    Pairs pairs;
    for (int i = 0; i < count; ++i)
        if (i != hub) pairs.emplace_back(std::min(i, hub), std::max(i, hub));
    std::sort(pairs.begin(), pairs.end());
    return pairs;
}

/// A sheet, and bodies that each touch a good part of it.
System sheet_with_bodies(int n, int body_count, check::Random& random) {
    std::vector<int> sizes(static_cast<std::size_t>(n * n), 3);
    Pairs pairs = sheet_pairs(n);
    for (int body = 0; body < body_count; ++body) {
        sizes.push_back(6);
        for (int node = body; node < n * n; node += 2 + body) pairs.emplace_back(node, n * n + body);
    }
    std::sort(pairs.begin(), pairs.end());
    return make_system(std::move(sizes), std::move(pairs), random);
}

}  // namespace

TEST(sparse_block_cholesky_agrees_with_a_dense_one_on_random_graphs) {
    check::Random random(1);
    SparseBlockCholesky reused;
    for (int trial = 0; trial < 300; ++trial) {
        NOTE(trial);
        const int count = 1 + trial % 45;
        const double probability = random.uniform(0.0, trial % 3 == 0 ? 1.0 : 6.0 / count);
        const std::vector<int> choice =
            trial % 2 == 0 ? std::vector<int>{3, 6} : std::vector<int>{1, 2, 3, 4, 5, 6, 7, 12};
        const System system =
            make_system(random_sizes(random, count, choice), random_pairs(random, count, probability), random);
        reused.analyze(system.sizes, system.pairs);
        check_solution(reused, system, random);
    }
}

TEST(sparse_block_cholesky_of_common_graphs) {
    check::Random random(2);
    SparseBlockCholesky cholesky;
    const auto check_graph = [&](const std::vector<int>& sizes, const Pairs& pairs) {
        const System system = make_system(sizes, pairs, random);
        cholesky.analyze(sizes, pairs);
        check_solution(cholesky, system, random);
    };
    for (const int n : {2, 5, 12, 16}) {
        NOTE(n);
        check_graph(std::vector<int>(static_cast<std::size_t>(n * n), 3), sheet_pairs(n));
    }
    for (const int count : {2, 3, 10, 150}) {
        NOTE(count);
        check_graph(std::vector<int>(static_cast<std::size_t>(count), 6), chain_pairs(count));
        check_graph(std::vector<int>(static_cast<std::size_t>(count), 3), {});
        for (const int hub : {0, count / 2, count - 1}) {
            NOTE(hub);
            std::vector<int> sizes(static_cast<std::size_t>(count), 3);
            sizes[hub] = 6;
            check_graph(sizes, star_pairs(count, hub));
        }
    }
    for (const int body_count : {1, 3}) {
        NOTE(body_count);
        const System system = sheet_with_bodies(11, body_count, random);
        cholesky.analyze(system.sizes, system.pairs);
        check_solution(cholesky, system, random);
    }
    // All pairs: one front, larger than the blocks of its elimination, with and without padding.
    for (const int count : {20, 31}) {
        NOTE(count);
        check_graph(std::vector<int>(static_cast<std::size_t>(count), 6), random_pairs(random, count, 2.0));
    }
    // Pieces that do not touch, and a block by itself.
    Pairs pieces = chain_pairs(20);
    for (const auto& [i, j] : sheet_pairs(6)) pieces.emplace_back(21 + i, 21 + j);
    check_graph(random_sizes(random, 57, {3, 6}), pieces);
}

TEST(sparse_block_cholesky_of_graphs_large_enough_to_be_dissected) {
    check::Random random(8);
    SparseBlockCholesky cholesky;
    const int n = 6;
    const System system = make_system(std::vector<int>(static_cast<std::size_t>(n * n * n), 6), heap_pairs(n), random);
    cholesky.analyze(system.sizes, system.pairs);
    check_solution(cholesky, system, random);
}

TEST(sparse_block_cholesky_of_nothing_and_of_one_block) {
    SparseBlockCholesky cholesky;
    CHECK(cholesky.rows() == 0);
    CHECK(cholesky.factorize(nullptr, nullptr));
    cholesky.solve_in_place(nullptr);
    cholesky.analyze({}, {});
    CHECK(cholesky.factorize(nullptr, nullptr));
    cholesky.solve_in_place(nullptr);

    check::Random random(3);
    for (const int size : {1, 3, 6}) {
        NOTE(size);
        System system = make_system({size}, {}, random);
        system.diagonal[0] *= 4.0;
        cholesky.analyze(system.sizes, {});
        CHECK(factorize(cholesky, system));
        CHECK_NEAR(solve(cholesky, VectorX::Ones(size)), VectorX::Constant(size, 0.25), 0.0);
    }
    cholesky.analyze({}, {});
    CHECK(cholesky.rows() == 0);
    CHECK(cholesky.factorize(nullptr, nullptr));
}

TEST(sparse_block_cholesky_takes_new_numbers_and_new_patterns) {
    check::Random random(4);
    SparseBlockCholesky cholesky;
    System system = sheet_with_bodies(8, 2, random);
    cholesky.analyze(system.sizes, system.pairs);
    for (int repeat = 0; repeat < 3; ++repeat) {
        fill(system, random);
        check_solution(cholesky, system, random);
    }
    for (const int count : {3, 60, 10}) {
        NOTE(count);
        System other = make_system(random_sizes(random, count, {3, 6}), random_pairs(random, count, 0.1), random);
        cholesky.analyze(other.sizes, other.pairs);
        check_solution(cholesky, other, random);
    }
    SparseBlockCholesky moved = std::move(cholesky);
    moved.analyze(system.sizes, system.pairs);
    check_solution(moved, system, random);
}

TEST(sparse_block_cholesky_reads_the_lower_triangle_of_diagonal_blocks) {
    check::Random random(5);
    System system = sheet_with_bodies(5, 1, random);
    SparseBlockCholesky cholesky;
    cholesky.analyze(system.sizes, system.pairs);
    for (MatrixX& block : system.diagonal) {
        block.triangularView<Eigen::StrictlyUpper>().setConstant(std::numeric_limits<double>::quiet_NaN());
    }
    check_solution(cholesky, system, random);
}

TEST(sparse_block_cholesky_refuses_what_is_not_positive_definite) {
    check::Random random(6);
    System system = sheet_with_bodies(9, 2, random);
    SparseBlockCholesky cholesky;
    cholesky.analyze(system.sizes, system.pairs);
    const double nan = std::numeric_limits<double>::quiet_NaN();
    const int block_count = static_cast<int>(system.sizes.size());
    for (int i = 0; i < block_count; i += 5) {
        NOTE(i);
        for (const double value : {-1.0, 0.0, nan, kInfinity, -kInfinity}) {
            NOTE(value);
            System broken = system;
            broken.diagonal[i](system.sizes[i] - 1, system.sizes[i] - 1) = value;
            CHECK(!factorize(cholesky, broken));
        }
    }
    for (std::size_t k = 0; k < system.pairs.size(); k += 17) {
        NOTE(k);
        for (const double value : {1e3, nan, kInfinity}) {
            NOTE(value);
            System broken = system;
            broken.upper[k](0, 2) = value;
            CHECK(!factorize(cholesky, broken));
        }
    }
    // Indefinite although no diagonal entry shows it: less than the smallest eigenvalue stays, more does not.
    const MatrixX matrix = system.dense();
    const double smallest = matrix.selfadjointView<Eigen::Lower>().eigenvalues().minCoeff();
    for (const double shift : {0.999 * smallest, 1.001 * smallest}) {
        NOTE(shift);
        System shifted = system;
        for (MatrixX& block : shifted.diagonal) block.diagonal().array() -= shift;
        CHECK(factorize(cholesky, shifted) == (shift < smallest));
    }
    check_solution(cholesky, system, random);  // usable as ever
}

TEST(half_solutions_give_products_with_the_inverse) {
    check::Random random(8);
    std::vector<System> systems;
    systems.push_back(make_system(random_sizes(random, 30, {3, 6}), random_pairs(random, 30, 0.1), random));
    systems.push_back(make_system(std::vector<int>(100, 3), sheet_pairs(10), random));
    systems.push_back(make_system({3, 6, 2, 3}, {}, random));  // nothing coupled
    for (const System& system : systems) {
        SparseBlockCholesky cholesky;
        cholesky.analyze(system.sizes, system.pairs);
        CHECK(factorize(cholesky, system));
        const std::vector<int> start = system.starts();
        const int count = static_cast<int>(system.sizes.size());
        std::vector<HalfSolution> halves;
        std::vector<VectorX> rhs;
        for (int k = 0; k < 12; ++k) {
            std::vector<int> blocks;
            std::vector<double> values;
            rhs.push_back(VectorX::Zero(start.back()));
            for (int b = 0; b < 1 + k % 3; ++b) {
                const int block = static_cast<int>(random.uniform(0.0, count));  // may come twice
                const VectorX part = random.vector(system.sizes[block]);
                blocks.push_back(block);
                values.insert(values.end(), part.begin(), part.end());
                rhs.back().segment(start[block], part.size()) += part;
            }
            cholesky.half_solve(blocks, values.data(), halves.emplace_back());
        }
        for (std::size_t i = 0; i < rhs.size(); ++i) {
            const VectorX x = solve(cholesky, rhs[i]);
            for (std::size_t j = 0; j < rhs.size(); ++j) {
                const double product = halves[i].dot(halves[j]);
                CHECK(product == halves[j].dot(halves[i]));
                CHECK_NEAR(product, x.dot(rhs[j]), kRounding * (1.0 + x.norm() * rhs[j].norm()));
            }
            CHECK(halves[i].dot(halves[i]) > 0.0);
        }
    }
}

TEST(sparse_block_cholesky_is_deterministic) {
    check::Random random(7);
    const System system = sheet_with_bodies(14, 3, random), other = sheet_with_bodies(6, 1, random);
    const VectorX rhs = random.vector(system.starts().back());

    SparseBlockCholesky fresh, reused;
    fresh.analyze(system.sizes, system.pairs);
    CHECK(factorize(fresh, system));
    const VectorX x = solve(fresh, rhs);
    CHECK(same_bits(solve(fresh, rhs), x));
    CHECK(factorize(fresh, system));
    CHECK(same_bits(solve(fresh, rhs), x));

    reused.analyze(other.sizes, other.pairs);
    CHECK(factorize(reused, other));
    System broken = other;
    broken.diagonal[20](0, 0) = std::numeric_limits<double>::quiet_NaN();
    CHECK(!factorize(reused, broken));  // leaves NaN in its work space
    reused.analyze(system.sizes, system.pairs);
    CHECK(factorize(reused, system));
    CHECK(same_bits(solve(reused, rhs), x));

    // A right-hand side at another alignment.
    std::vector<double> shifted(static_cast<std::size_t>(rhs.size()) + 1);
    std::copy_n(rhs.data(), rhs.size(), shifted.begin() + 1);
    fresh.solve_in_place(shifted.data() + 1);
    CHECK(same_bits(Eigen::Map<const VectorX>(shifted.data() + 1, rhs.size()), x));
}

}  // namespace test_sparse_block_cholesky
