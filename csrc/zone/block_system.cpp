#include "zone/block_system.hpp"

#include <Eigen/Cholesky>
#include <algorithm>

namespace diffsim {
namespace {

/// Up to this many bodies a dense factor is faster than a sparse one.
constexpr int kDenseLimit = 8;

/// Where the pairs of each first index begin in a sorted list.
void find_firsts(const IndexPairs& pairs, int count, std::vector<int>& first) {
    first.assign(static_cast<std::size_t>(count) + 1, 0);
    for (const auto& pair : pairs) ++first[static_cast<std::size_t>(pair.first) + 1];
    for (int i = 0; i < count; ++i) first[static_cast<std::size_t>(i) + 1] += first[i];
}

int find_pair(const IndexPairs& pairs, const std::vector<int>& first, int i, int j) {
    const auto begin = pairs.begin() + first[i], end = pairs.begin() + first[static_cast<std::size_t>(i) + 1];
    const auto found = std::lower_bound(begin, end, std::pair(i, j));
    return found != end && found->second == j ? static_cast<int>(found - pairs.begin()) : -1;
}

}  // namespace

struct BlockSystem::SparseFactor {
    SparseBlockCholesky factor;
    std::vector<const double*> diagonal, upper;  ///< the blocks, in the factor's order
    mutable std::vector<double> x;
};

BlockSystem::BlockSystem() = default;
BlockSystem::~BlockSystem() = default;
BlockSystem::BlockSystem(BlockSystem&&) noexcept = default;
BlockSystem& BlockSystem::operator=(BlockSystem&&) noexcept = default;

void BlockSystem::set_pattern(BlockPattern pattern) {
    if (pattern == m_pattern) return;
    m_pattern_changed = true;
    m_pattern = std::move(pattern);
    m_diagonal.resize(static_cast<std::size_t>(m_pattern.body_count));
    m_off_diagonal.resize(m_pattern.body_pairs.size());
    m_node_diagonal.resize(static_cast<std::size_t>(m_pattern.node_count));
    m_node_pairs.resize(m_pattern.node_pairs.size());
    m_mixed_pairs.resize(m_pattern.mixed_pairs.size());
    if (m_pattern.node_count == 0) return;
    find_firsts(m_pattern.node_pairs, m_pattern.node_count, m_node_first);
    find_firsts(m_pattern.mixed_pairs, m_pattern.body_count, m_mixed_first);
}

void BlockSystem::set_zero() {
    for (Mat6& block : m_diagonal) block.setZero();
    for (Mat6& block : m_off_diagonal) block.setZero();
    for (Mat3& block : m_node_diagonal) block.setZero();
    for (Mat3& block : m_node_pairs) block.setZero();
    for (Mat63& block : m_mixed_pairs) block.setZero();
}

void BlockSystem::copy_values(const BlockSystem& other) {
    // Copied into what is there: the sparse factor points to the blocks.
    std::copy(other.m_diagonal.begin(), other.m_diagonal.end(), m_diagonal.begin());
    std::copy(other.m_off_diagonal.begin(), other.m_off_diagonal.end(), m_off_diagonal.begin());
    std::copy(other.m_node_diagonal.begin(), other.m_node_diagonal.end(), m_node_diagonal.begin());
    std::copy(other.m_node_pairs.begin(), other.m_node_pairs.end(), m_node_pairs.begin());
    std::copy(other.m_mixed_pairs.begin(), other.m_mixed_pairs.end(), m_mixed_pairs.begin());
}

int BlockSystem::find_node_pair(int i, int j) const { return find_pair(m_pattern.node_pairs, m_node_first, i, j); }

int BlockSystem::find_mixed_pair(int body, int node) const {
    return find_pair(m_pattern.mixed_pairs, m_mixed_first, body, node);
}

bool BlockSystem::is_sparse() const { return m_pattern.node_count > 0 || m_pattern.body_count > kDenseLimit; }

bool BlockSystem::factorize() {
    if (is_sparse()) return factorize_sparse();
    const int count = m_pattern.body_count;
    if (count == 1) return m_single.factorize(m_diagonal[0]);
    m_dense.setZero(6 * count, 6 * count);
    for (int i = 0; i < count; ++i) m_dense.block<6, 6>(6 * i, 6 * i) = m_diagonal[i];
    for (std::size_t k = 0; k < m_pattern.body_pairs.size(); ++k) {
        const auto [i, j] = m_pattern.body_pairs[k];
        m_dense.block<6, 6>(6 * j, 6 * i) = m_off_diagonal[k].transpose();
    }
    return Eigen::internal::llt_inplace<double, Eigen::Lower>::blocked(m_dense) == -1;
}

bool BlockSystem::factorize_sparse() {
    if (!m_sparse) m_sparse = std::make_unique<SparseFactor>();
    SparseFactor& sparse = *m_sparse;
    if (m_pattern_changed) {
        // Blocks of the factor: the bodies, then the nodes. Its pairs, sorted: each body's
        // with bodies, then with nodes.
        const int bodies = m_pattern.body_count;
        std::vector<int> sizes(static_cast<std::size_t>(bodies), 6);
        sizes.resize(static_cast<std::size_t>(bodies + m_pattern.node_count), 3);
        IndexPairs pairs;
        sparse.diagonal.clear();
        sparse.upper.clear();
        std::size_t body_pair = 0, mixed_pair = 0;
        for (int i = 0; i < bodies; ++i) {
            sparse.diagonal.push_back(m_diagonal[i].data());
            for (; body_pair < m_pattern.body_pairs.size() && m_pattern.body_pairs[body_pair].first == i; ++body_pair) {
                pairs.push_back(m_pattern.body_pairs[body_pair]);
                sparse.upper.push_back(m_off_diagonal[body_pair].data());
            }
            for (; mixed_pair < m_pattern.mixed_pairs.size() && m_pattern.mixed_pairs[mixed_pair].first == i;
                 ++mixed_pair) {
                pairs.emplace_back(i, bodies + m_pattern.mixed_pairs[mixed_pair].second);
                sparse.upper.push_back(m_mixed_pairs[mixed_pair].data());
            }
        }
        for (const Mat3& block : m_node_diagonal) sparse.diagonal.push_back(block.data());
        for (std::size_t k = 0; k < m_node_pairs.size(); ++k) {
            pairs.emplace_back(bodies + m_pattern.node_pairs[k].first, bodies + m_pattern.node_pairs[k].second);
            sparse.upper.push_back(m_node_pairs[k].data());
        }
        sparse.factor.analyze(sizes, pairs);
        m_pattern_changed = false;
    }
    return sparse.factor.factorize(sparse.diagonal.data(), sparse.upper.data());
}

void BlockSystem::solve_in_place(Coordinates& rhs) const {
    if (is_sparse()) {
        std::vector<double>& x = m_sparse->x;
        const std::size_t body_rows = 6 * rhs.bodies.size();
        x.resize(body_rows + 3 * rhs.nodes.size());
        for (std::size_t i = 0; i < rhs.bodies.size(); ++i) Eigen::Map<Vec6>(x.data() + 6 * i) = rhs.bodies[i];
        for (std::size_t i = 0; i < rhs.nodes.size(); ++i)
            Eigen::Map<Vec3>(x.data() + body_rows + 3 * i) = rhs.nodes[i];
        m_sparse->factor.solve_in_place(x.data());
        for (std::size_t i = 0; i < rhs.bodies.size(); ++i) rhs.bodies[i] = Eigen::Map<Vec6>(x.data() + 6 * i);
        for (std::size_t i = 0; i < rhs.nodes.size(); ++i)
            rhs.nodes[i] = Eigen::Map<Vec3>(x.data() + body_rows + 3 * i);
        return;
    }
    if (m_pattern.body_count == 1) return m_single.solve_in_place(rhs.bodies[0]);
    Eigen::Map<VectorX> x(rhs.bodies[0].data(), 6 * m_pattern.body_count);
    m_dense.triangularView<Eigen::Lower>().solveInPlace(x);
    m_dense.triangularView<Eigen::Lower>().transpose().solveInPlace(x);
}

HalfSolution BlockSystem::half_solve(std::vector<int> nodes, const std::vector<Vec3>& values) const {
    for (int& node : nodes) node += m_pattern.body_count;
    HalfSolution result;
    m_sparse->factor.half_solve(nodes, values.empty() ? nullptr : values[0].data(), result);
    return result;
}

void BlockSystem::multiply(const Coordinates& in, Coordinates& out) const {
    out.resize(in.bodies.size(), in.nodes.size());
    for (std::size_t i = 0; i < m_diagonal.size(); ++i) out.bodies[i].noalias() = m_diagonal[i] * in.bodies[i];
    for (std::size_t i = 0; i < m_node_diagonal.size(); ++i) out.nodes[i].noalias() = m_node_diagonal[i] * in.nodes[i];
    for (std::size_t k = 0; k < m_off_diagonal.size(); ++k) {
        const auto [i, j] = m_pattern.body_pairs[k];
        out.bodies[i].noalias() += m_off_diagonal[k] * in.bodies[j];
        out.bodies[j].noalias() += m_off_diagonal[k].transpose() * in.bodies[i];
    }
    for (std::size_t k = 0; k < m_mixed_pairs.size(); ++k) {
        const auto [i, j] = m_pattern.mixed_pairs[k];
        out.bodies[i].noalias() += m_mixed_pairs[k] * in.nodes[j];
        out.nodes[j].noalias() += m_mixed_pairs[k].transpose() * in.bodies[i];
    }
    for (std::size_t k = 0; k < m_node_pairs.size(); ++k) {
        const auto [i, j] = m_pattern.node_pairs[k];
        out.nodes[i].noalias() += m_node_pairs[k] * in.nodes[j];
        out.nodes[j].noalias() += m_node_pairs[k].transpose() * in.nodes[i];
    }
}

}  // namespace diffsim
