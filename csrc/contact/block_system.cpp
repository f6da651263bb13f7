#include "contact/block_system.hpp"

#include <Eigen/Cholesky>
#include <Eigen/SparseCholesky>

namespace diffsim {
namespace {

/// Up to this many bodies a dense factor is faster than a sparse one.
constexpr int kDenseLimit = 8;

}  // namespace

struct BlockSystem::SparseFactor {
    Eigen::SparseMatrix<double> matrix;
    std::vector<double*> slots;  ///< where the entries of the blocks' lower triangle go, in order of assembly
    Eigen::SimplicialLLT<Eigen::SparseMatrix<double>, Eigen::Lower> factor;
};

BlockSystem::BlockSystem() = default;
BlockSystem::~BlockSystem() = default;
BlockSystem::BlockSystem(BlockSystem&&) noexcept = default;
BlockSystem& BlockSystem::operator=(BlockSystem&&) noexcept = default;

void BlockSystem::set_pattern(int body_count, std::vector<std::pair<int, int>> pairs) {
    m_pattern_changed = m_pattern_changed || body_count != m_body_count || pairs != m_pairs;
    m_body_count = body_count;
    m_pairs = std::move(pairs);
    m_diagonal.resize(static_cast<std::size_t>(body_count));
    m_off_diagonal.resize(m_pairs.size());
}

void BlockSystem::set_zero() {
    for (Mat6& block : m_diagonal) block.setZero();
    for (Mat6& block : m_off_diagonal) block.setZero();
}

bool BlockSystem::factorize() {
    if (m_body_count == 1) {
        m_single = m_diagonal[0];
        return Eigen::internal::llt_inplace<double, Eigen::Lower>::unblocked(m_single) == -1;
    }
    if (m_body_count <= kDenseLimit) {
        m_dense.setZero(6 * m_body_count, 6 * m_body_count);
        for (int i = 0; i < m_body_count; ++i) m_dense.block<6, 6>(6 * i, 6 * i) = m_diagonal[i];
        for (std::size_t k = 0; k < m_pairs.size(); ++k)
            m_dense.block<6, 6>(6 * m_pairs[k].second, 6 * m_pairs[k].first) = m_off_diagonal[k].transpose();
        return Eigen::internal::llt_inplace<double, Eigen::Lower>::blocked(m_dense) == -1;
    }
    if (!m_sparse) m_sparse = std::make_unique<SparseFactor>();
    SparseFactor& sparse = *m_sparse;
    if (m_pattern_changed) {
        std::vector<Eigen::Triplet<double>> triplets;
        triplets.reserve(21 * m_diagonal.size() + 36 * m_pairs.size());
        for (int i = 0; i < m_body_count; ++i)
            for (int c = 0; c < 6; ++c)
                for (int r = c; r < 6; ++r) triplets.emplace_back(6 * i + r, 6 * i + c, 1.0);
        for (const auto& [i, j] : m_pairs)
            for (int c = 0; c < 6; ++c)
                for (int r = 0; r < 6; ++r) triplets.emplace_back(6 * j + r, 6 * i + c, 1.0);
        sparse.matrix.resize(6 * m_body_count, 6 * m_body_count);
        sparse.matrix.setFromTriplets(triplets.begin(), triplets.end());
        sparse.slots.clear();
        for (const auto& t : triplets) sparse.slots.push_back(&sparse.matrix.coeffRef(t.row(), t.col()));
        sparse.factor.analyzePattern(sparse.matrix);
        m_pattern_changed = false;
    }
    std::size_t slot = 0;
    for (const Mat6& block : m_diagonal)
        for (int c = 0; c < 6; ++c)
            for (int r = c; r < 6; ++r) *sparse.slots[slot++] = block(r, c);
    for (const Mat6& block : m_off_diagonal)
        for (int c = 0; c < 6; ++c)
            for (int r = 0; r < 6; ++r) *sparse.slots[slot++] = block(c, r);
    sparse.factor.factorize(sparse.matrix);
    return sparse.factor.info() == Eigen::Success;
}

void BlockSystem::solve_in_place(std::vector<Vec6>& rhs) const {
    if (m_body_count == 1) {
        m_single.triangularView<Eigen::Lower>().solveInPlace(rhs[0]);
        m_single.triangularView<Eigen::Lower>().transpose().solveInPlace(rhs[0]);
        return;
    }
    Eigen::Map<VectorX> x(rhs[0].data(), 6 * m_body_count);
    if (m_body_count <= kDenseLimit) {
        m_dense.triangularView<Eigen::Lower>().solveInPlace(x);
        m_dense.triangularView<Eigen::Lower>().transpose().solveInPlace(x);
    } else {
        x = m_sparse->factor.solve(x).eval();
    }
}

void BlockSystem::multiply(const std::vector<Vec6>& in, std::vector<Vec6>& out) const {
    out.resize(in.size());
    for (int i = 0; i < m_body_count; ++i) out[i].noalias() = m_diagonal[i] * in[i];
    for (std::size_t k = 0; k < m_pairs.size(); ++k) {
        const auto [i, j] = m_pairs[k];
        out[i].noalias() += m_off_diagonal[k] * in[j];
        out[j].noalias() += m_off_diagonal[k].transpose() * in[i];
    }
}

}  // namespace diffsim
