#include "zone/block_system.hpp"

#include <Eigen/Cholesky>
#include <utility>

#include "fixtures.hpp"

namespace test_block_system {

using namespace diffsim;
using Pairs = std::vector<std::pair<int, int>>;

namespace {

constexpr double kRounding = 1e-11;  // condition numbers below 1e3, 240 unknowns

/// A chain with some longer links, as the contact graph of a pile has.
Pairs random_pairs(check::Random& random, int count) {
    Pairs pairs;
    for (int i = 0; i < count; ++i)
        for (int j = i + 1; j < count; ++j)
            if (j == i + 1 || random.uniform(0.0, 1.0) < 3.0 / count) pairs.emplace_back(i, j);
    return pairs;
}

/// Bodies in a chain, nodes in another, and each body coupled to some nodes.
BlockPattern random_pattern(check::Random& random, int bodies, int nodes) {
    BlockPattern pattern{bodies, nodes, random_pairs(random, bodies), {}, random_pairs(random, nodes)};
    for (int i = 0; i < bodies; ++i)
        for (int j = 0; j < nodes; ++j)
            if (random.uniform(0.0, 1.0) < 3.0 / nodes) pattern.mixed_pairs.emplace_back(i, j);
    return pattern;
}

/// Σ over pairs of a random Gram matrix, plus the identity.
void fill(BlockSystem& system, check::Random& random) {
    system.set_zero();
    const BlockPattern& pattern = system.pattern();
    for (int i = 0; i < pattern.body_count; ++i) system.diagonal(i) = Mat6::Identity();
    for (int i = 0; i < pattern.node_count; ++i) system.node_diagonal(i) = Mat3::Identity();
    for (std::size_t k = 0; k < pattern.node_pairs.size(); ++k) {
        const auto [i, j] = pattern.node_pairs[k];
        const MatrixX rows = random.matrix(6, 6), gram = rows * rows.transpose();
        system.node_diagonal(i) += gram.topLeftCorner<3, 3>();
        system.node_diagonal(j) += gram.bottomRightCorner<3, 3>();
        system.node_pair(static_cast<int>(k)) += gram.topRightCorner<3, 3>();
    }
    for (std::size_t k = 0; k < pattern.mixed_pairs.size(); ++k) {
        const auto [i, j] = pattern.mixed_pairs[k];
        const MatrixX rows = random.matrix(9, 9), gram = rows * rows.transpose();
        system.diagonal(i) += gram.topLeftCorner<6, 6>();
        system.node_diagonal(j) += gram.bottomRightCorner<3, 3>();
        system.mixed_pair(static_cast<int>(k)) += gram.topRightCorner<6, 3>();
    }
    for (std::size_t k = 0; k < system.pattern().body_pairs.size(); ++k) {
        const auto [i, j] = system.pattern().body_pairs[k];
        const MatrixX rows = random.matrix(12, 12), gram = rows * rows.transpose();
        system.diagonal(i) += gram.topLeftCorner<6, 6>();
        system.diagonal(j) += gram.bottomRightCorner<6, 6>();
        system.off_diagonal(static_cast<int>(k)) += gram.topRightCorner<6, 6>();
    }
}

void check_solution(BlockSystem& system, check::Random& random) {
    const MatrixX matrix = fixtures::dense(system);
    const VectorX rhs = random.vector(matrix.rows());
    CHECK(system.factorize());
    Coordinates x = fixtures::unflatten(rhs, system.pattern().body_count), product;
    system.multiply(x, product);
    CHECK_NEAR(fixtures::flatten(product), matrix * rhs, kRounding * matrix.norm());
    system.solve_in_place(x);
    CHECK_NEAR(fixtures::flatten(x), matrix.ldlt().solve(rhs), kRounding);
    CHECK_NEAR(matrix * fixtures::flatten(x), rhs, kRounding * matrix.norm());
}

}  // namespace

TEST(block_system_agrees_with_a_dense_matrix) {
    check::Random random(1);
    for (const int count : {1, 2, 3, 8, 9, 40}) {
        NOTE(count);
        BlockSystem system;
        system.set_pattern({count, 0, random_pairs(random, count), {}, {}});
        fill(system, random);
        check_solution(system, random);
        fill(system, random);  // the same pattern, other numbers
        check_solution(system, random);
    }
}

TEST(block_system_can_change_its_pattern) {
    check::Random random(2);
    BlockSystem system;
    for (const int count : {40, 3, 12, 1, 12, 40}) {
        NOTE(count);
        system.set_pattern({count, 0, random_pairs(random, count), {}, {}});
        fill(system, random);
        check_solution(system, random);
    }
    system.set_pattern({40, 0, {{0, 39}}, {}, {}});  // as many bodies, other pairs
    fill(system, random);
    check_solution(system, random);
    BlockSystem moved = std::move(system);
    check_solution(moved, random);
}

TEST(block_system_without_pairs) {
    check::Random random(3);
    for (const int count : {1, 5, 20}) {
        BlockSystem system;
        system.set_pattern({count, 0, {}, {}, {}});
        fill(system, random);
        for (int i = 0; i < count; ++i) system.diagonal(i) *= 1.0 + i;
        Coordinates x = fixtures::unflatten(VectorX::Ones(6 * count));
        CHECK(system.factorize());
        system.solve_in_place(x);
        for (int i = 0; i < count; ++i) CHECK_NEAR(x.bodies[i], Vec6::Constant(1.0 / (1.0 + i)), 1e-15);
    }
}

TEST(block_system_refuses_what_is_not_positive_definite) {
    check::Random random(4);
    for (const int count : {1, 3, 8, 9, 40}) {
        NOTE(count);
        BlockSystem system;
        system.set_pattern({count, 0, random_pairs(random, count), {}, {}});
        fill(system, random);
        system.diagonal(count - 1)(5, 5) = -1.0;
        CHECK(!system.factorize());
        fill(system, random);
        CHECK(system.factorize());
    }
}

TEST(block_system_of_bodies_and_nodes_agrees_with_a_dense_matrix) {
    check::Random random(5);
    BlockSystem system;
    for (const auto& [bodies, nodes] :
         {std::pair(0, 1), std::pair(0, 30), std::pair(1, 1), std::pair(2, 40), std::pair(12, 25), std::pair(3, 0),
          std::pair(2, 40)}) {
        NOTE(bodies);
        NOTE(nodes);
        const BlockPattern pattern = random_pattern(random, bodies, nodes);
        system.set_pattern(pattern);
        CHECK(system.pattern() == pattern);
        fill(system, random);
        check_solution(system, random);
        fill(system, random);  // the same pattern, other numbers
        check_solution(system, random);
        if (nodes == 0) continue;
        fill(system, random);
        system.node_diagonal(nodes - 1)(2, 2) = -1.0;
        CHECK(!system.factorize());
    }
}

TEST(block_system_finds_its_pairs) {
    check::Random random(6);
    const int bodies = 5, nodes = 20;
    const BlockPattern pattern = random_pattern(random, bodies, nodes);
    BlockSystem system;
    system.set_pattern(pattern);
    int mixed = 0, pairs = 0;
    for (int j = 0; j < nodes; ++j) {
        for (int i = 0; i < bodies; ++i) {
            const int found = system.find_mixed_pair(i, j);
            if (found < 0) continue;
            CHECK(pattern.mixed_pairs[static_cast<std::size_t>(found)] == std::pair(i, j));
            ++mixed;
        }
        for (int i = 0; i < j; ++i) {
            const int found = system.find_node_pair(i, j);
            if (found < 0) continue;
            CHECK(pattern.node_pairs[static_cast<std::size_t>(found)] == std::pair(i, j));
            ++pairs;
        }
    }
    CHECK(mixed == static_cast<int>(pattern.mixed_pairs.size()));
    CHECK(pairs == static_cast<int>(pattern.node_pairs.size()));
    CHECK(mixed >= 5);
}

}  // namespace test_block_system
