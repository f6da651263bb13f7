#include "zone/side_matrices.hpp"

#include "fixtures.hpp"

namespace test_side_matrices {

using namespace diffsim;

namespace {

/// What a contact's matrix is taken along.
struct Term {
    std::array<ContactTerm::Side, 2> sides;
    int side_count;
};

ContactTerm::Side of_body(int body, int offset) {
    ContactTerm::Side side;
    side.body = body;
    side.offset = offset;
    return side;
}

}  // namespace

TEST(matrices_over_sides_act_as_the_dense_matrix_of_what_yields) {
    check::Random random(11);
    Zone zone;
    for (int i = 0; i < 3; ++i) zone.bodies.push_back(fixtures::zone_body(i, Pose(), 1.0, Mat3::Identity()));
    zone.dynamic_count = 2;  // the third moves as told
    zone.nodes.resize(3);
    zone.nodes[1].pinned = true;
    ContactTerm::Side of_nodes;
    of_nodes.nodes = {2, 1, 0};
    of_nodes.offset = 6;
    const std::vector<Term> terms = {
        {{of_body(0, 0), of_body(1, 6)}, 2}, {{of_body(0, 0), of_body(1, 6)}, 2}, {{of_body(1, 0), {}}, 1},
        {{of_body(1, 0), of_body(2, 6)}, 2}, {{of_body(0, 0), of_nodes}, 2},
    };
    const auto row = [](const ContactTerm::Side& side, int k) {  // among 2 bodies and 3 nodes; -1: does not yield
        if (side.body >= 0) return side.body < 2 ? 6 * side.body + k : -1;
        const int node = side.nodes[static_cast<std::size_t>(k / 3)];
        return node == 1 ? -1 : 12 + 3 * node + k % 3;
    };
    MatrixX dense = MatrixX::Zero(21, 21);
    SideMatrices matrices;
    for (const Term& term : terms) {
        std::vector<int> rows;
        for (int s = 0; s < term.side_count; ++s) {
            const ContactTerm::Side& side = term.sides[static_cast<std::size_t>(s)];
            for (int k = 0; k < (side.body >= 0 ? 6 : 9); ++k) rows.push_back(row(side, k));
        }
        const SmallMatrix matrix =
            random.matrix(static_cast<Eigen::Index>(rows.size()), static_cast<Eigen::Index>(rows.size()));
        matrices.add(term, matrix);
        for (std::size_t i = 0; i < rows.size(); ++i)
            for (std::size_t j = 0; j < rows.size(); ++j)
                if (rows[i] >= 0 && rows[j] >= 0)
                    dense(rows[i], rows[j]) += matrix(static_cast<Eigen::Index>(i), static_cast<Eigen::Index>(j));
    }
    const VectorX x = random.matrix(21, 1), begin = random.matrix(21, 1);
    Coordinates sum = fixtures::unflatten(begin, 2);
    matrices.add_product(zone, -2.0, fixtures::unflatten(x, 2), sum);
    CHECK_NEAR(fixtures::flatten(sum), VectorX(begin - 2.0 * dense * x), 1e-12);
    sum = fixtures::unflatten(begin, 2);
    matrices.add_transposed_product(zone, 0.5, fixtures::unflatten(x, 2), sum);
    CHECK_NEAR(fixtures::flatten(sum), VectorX(begin + 0.5 * dense.transpose() * x), 1e-12);
}

}  // namespace test_side_matrices
