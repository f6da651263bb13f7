#include "adjoint/linearised_zone.hpp"

#include <Eigen/Cholesky>
#include <Eigen/LU>
#include <Eigen/QR>
#include <optional>

#include "zone/chart.hpp"
#include "zone/contact_term.hpp"
#include "zone/elasticity.hpp"

namespace diffsim {
namespace {

/// The free coordinates as one vector: bodies, then nodes that are not pinned.
class FreeCoordinates {
public:
    explicit FreeCoordinates(const Zone& zone) : m_zone(zone), m_size(6 * zone.dynamic_count) {
        for (const ZoneNode& node : zone.nodes) {
            m_rows.push_back(node.pinned ? -1 : m_size);
            if (!node.pinned) m_size += 3;
        }
    }
    Eigen::Index size() const { return m_size; }
    Eigen::Index row(int node) const { return m_rows[static_cast<std::size_t>(node)]; }  ///< -1 if pinned

    VectorX flatten(const Coordinates& y) const {
        VectorX x(m_size);
        for (int i = 0; i < m_zone.dynamic_count; ++i) x.segment<6>(6 * i) = y.bodies[i];
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (row(i) >= 0) x.segment<3>(row(i)) = y.nodes[i];
        return x;
    }
    Coordinates unflatten(const VectorX& x) const {
        Coordinates y;
        y.assign_zero(static_cast<std::size_t>(m_zone.dynamic_count), m_zone.nodes.size());
        for (int i = 0; i < m_zone.dynamic_count; ++i) y.bodies[i] = x.segment<6>(6 * i);
        for (int i = 0; i < m_zone.node_count(); ++i)
            if (row(i) >= 0) y.nodes[i] = x.segment<3>(row(i));
        return y;
    }

private:
    const Zone& m_zone;
    Eigen::Index m_size;
    std::vector<Eigen::Index> m_rows;
};

/// The contacts as rows of the paper's J, in the free coordinates, and their stiffness.
/// Parallel edges have none, and no row.
struct Rows {
    MatrixX J;                           // m x n
    VectorX stiffness;                   // m [kg]
    std::vector<Eigen::Index> contacts;  // m, which of the active ones

    /// One value per active contact of one per row.
    VectorX of_contacts(const VectorX& of_rows, std::size_t contact_count) const {
        VectorX result = VectorX::Zero(static_cast<Eigen::Index>(contact_count));
        for (std::size_t k = 0; k < contacts.size(); ++k) result[contacts[k]] = of_rows[static_cast<Eigen::Index>(k)];
        return result;
    }
};

Rows collect_rows(const Zone& zone, const ZonePoint& point, const FreeCoordinates& free) {
    Rows rows;
    std::vector<ContactTerm> terms;
    for (std::size_t k = 0; k < point.active.size(); ++k) {
        const ContactTerm term = contact_term(zone, point, point.active[k], Curvature::none);
        if (term.stiffness == 0.0) continue;
        rows.contacts.push_back(static_cast<Eigen::Index>(k));
        terms.push_back(term);
    }
    const Eigen::Index count = static_cast<Eigen::Index>(terms.size());
    rows.J = MatrixX::Zero(count, free.size());
    rows.stiffness.resize(count);
    for (Eigen::Index k = 0; k < count; ++k) {
        const ContactTerm& term = terms[static_cast<std::size_t>(k)];
        rows.stiffness[k] = term.stiffness;
        term.for_each(
            [&](int body, int offset) {
                if (!zone.yields(body)) return;
                rows.J.block<1, 6>(k, 6 * body) =
                    term.row.segment<6>(offset).transpose() * chart_jacobian(point.y.bodies[body]);
            },
            [&](int node, int offset) {
                if (free.row(node) >= 0)
                    rows.J.block<1, 3>(k, free.row(node)) = term.row.segment<3>(offset).transpose();
            });
    }
    return rows;
}

Mat6 mass_matrix(const ZoneBody& body) {
    Mat6 mass = Mat6::Zero();
    mass.topLeftCorner<3, 3>() = body.inertia;
    mass.diagonal().tail<3>().setConstant(body.mass);
    return mass;
}

/// Inertia and elasticity of the cloths' free nodes.
MatrixX cloth_matrix(const Zone& zone, const ZonePoint& point, const FreeCoordinates& free, CutShare cut) {
    const Eigen::Index first = 6 * zone.dynamic_count, size = free.size() - first;
    MatrixX matrix = MatrixX::Zero(size, size);
    if (size == 0) return matrix;
    BlockSystem cloth;
    cloth.set_pattern(elastic_pattern(zone));
    cloth.set_zero();
    if (zone.elastic) add_elastic_hessian(zone, point, cut, cloth);
    for (int i = 0; i < zone.node_count(); ++i) {
        if (free.row(i) < 0) continue;
        const Eigen::Index r = free.row(i) - first;
        matrix.block<3, 3>(r, r) = cloth.node_diagonal(i) + zone.nodes[i].mass * Mat3::Identity();
    }
    const IndexPairs& pairs = cloth.pattern().node_pairs;
    for (std::size_t k = 0; k < pairs.size(); ++k) {
        const Eigen::Index r = free.row(pairs[k].first) - first, c = free.row(pairs[k].second) - first;
        if (r < 0 || c < 0) continue;
        matrix.block<3, 3>(r, c) = cloth.node_pair(static_cast<int>(k));
        matrix.block<3, 3>(c, r) = cloth.node_pair(static_cast<int>(k)).transpose();
    }
    return matrix;
}

/// With the exact elastic Hessian, or its projection where the exact one is not positive definite.
MatrixX cloth_matrix(const Zone& zone, const ZonePoint& point, const FreeCoordinates& free) {
    MatrixX cloth = cloth_matrix(zone, point, free, kNothingCut);
    if (cloth.rows() > 0 && cloth.llt().info() != Eigen::Success) cloth = cloth_matrix(zone, point, free, kAllCut);
    return cloth;
}

KktSolution solve_dense(
    const Zone& zone, const FreeCoordinates& free, const MatrixX& cloth, const Rows& rows,
    const Coordinates& upstream) {
    const Eigen::Index n = rows.J.cols(), m = rows.J.rows();
    MatrixX kkt = MatrixX::Zero(n + m, n + m);
    for (int i = 0; i < zone.dynamic_count; ++i) kkt.block<6, 6>(6 * i, 6 * i) = mass_matrix(zone.bodies[i]);
    kkt.block(6 * zone.dynamic_count, 6 * zone.dynamic_count, cloth.rows(), cloth.cols()) = cloth;
    kkt.topRightCorner(n, m) = rows.J.transpose();
    kkt.bottomLeftCorner(m, n) = rows.J;
    for (Eigen::Index k = 0; k < m; ++k) kkt(n + k, n + k) = -1.0 / rows.stiffness[k];
    VectorX rhs = VectorX::Zero(n + m);
    rhs.head(n) = free.flatten(upstream);
    const VectorX solution = kkt.partialPivLu().solve(rhs);
    return {free.unflatten(solution.head(n)), solution.tail(m)};
}

/// Cholesky factor of inertia and elasticity: 6x6 per body, one of all nodes.
class InertiaFactor {
public:
    InertiaFactor(const Zone& zone, const MatrixX& cloth) : m_bodies(zone.dynamic_count), m_cloth(cloth.llt()) {
        for (int i = 0; i < m_bodies; ++i) m_factors.push_back(mass_matrix(zone.bodies[i]).llt().matrixL());
    }
    /// Overwrite x by L⁻¹ x.
    template <class Matrix>
    void solve_lower(Matrix& x) const {
        for (int i = 0; i < m_bodies; ++i) {
            auto block = x.template middleRows<6>(6 * i);
            block = m_factors[static_cast<std::size_t>(i)].template triangularView<Eigen::Lower>().solve(block).eval();
        }
        if (m_cloth.rows() == 0) return;
        auto block = x.bottomRows(m_cloth.rows());
        block = m_cloth.matrixL().solve(block).eval();
    }
    /// Overwrite x by L⁻ᵀ x.
    void solve_upper(VectorX& x) const {
        for (int i = 0; i < m_bodies; ++i)
            m_factors[static_cast<std::size_t>(i)].triangularView<Eigen::Lower>().transpose().solveInPlace(
                x.segment<6>(6 * i));
        if (m_cloth.rows() == 0) return;
        auto block = x.tail(m_cloth.rows());
        block = m_cloth.matrixU().solve(block).eval();
    }

private:
    int m_bodies;
    std::vector<Mat6> m_factors;
    Eigen::LLT<MatrixX> m_cloth;
};

/// With B = stiffness^½ J L⁻ᵀ and Bᵀ P = Q R:  (I + Bᵀ B)⁻¹ = I - Q (I - (I + R Rᵀ)⁻¹) Qᵀ, whatever the rank of B, and
/// B (I + Bᵀ B)⁻¹ = P Rᵀ (I + R Rᵀ)⁻¹ Qᵀ.
KktSolution solve_qr(
    const FreeCoordinates& free, const InertiaFactor& factor, const Rows& rows, const Coordinates& upstream) {
    const Eigen::Index n = rows.J.cols(), m = rows.J.rows();
    VectorX v = free.flatten(upstream);
    factor.solve_lower(v);
    VectorX multipliers(m);
    if (m > 0) {
        const VectorX root = rows.stiffness.cwiseSqrt();
        MatrixX Bt = rows.J.transpose() * root.asDiagonal();
        factor.solve_lower(Bt);
        const Eigen::ColPivHouseholderQR<MatrixX> qr(Bt);
        const Eigen::Index rank = std::min(n, m);
        const MatrixX R = qr.matrixR().topRows(rank).template triangularView<Eigen::Upper>();
        const VectorX projected = (qr.householderQ().transpose() * v).head(rank);
        const MatrixX gram = MatrixX::Identity(rank, rank) + R * R.transpose();
        const VectorX kept = gram.llt().solve(projected);
        VectorX correction = VectorX::Zero(n);
        correction.head(rank) = projected - kept;
        v -= qr.householderQ() * correction;
        multipliers = root.cwiseProduct(qr.colsPermutation() * (R.transpose() * kept));
    }
    factor.solve_upper(v);
    return {free.unflatten(v), multipliers};
}

}  // namespace

LinearisedZone linearise(const Zone& zone, const ZonePoint& point) {
    const FreeCoordinates free(zone);
    Rows rows = collect_rows(zone, point, free);
    LinearisedZone result;
    result.inertia = MatrixX::Zero(free.size(), free.size());
    for (int i = 0; i < zone.dynamic_count; ++i) {
        result.bodies.push_back(zone.bodies[i].id);
        result.inertia.block<6, 6>(6 * i, 6 * i) = mass_matrix(zone.bodies[i]);
    }
    for (const ZoneCloth& part : zone.cloths) {
        const Cloth& cloth = zone.model->cloths[part.id];
        for (int k = 0; k < cloth.node_count(); ++k)
            if (free.row(part.first_node + k) >= 0) result.nodes.push_back(cloth.first_node + k);
    }
    const MatrixX cloth = cloth_matrix(zone, point, free);
    result.inertia.bottomRightCorner(cloth.rows(), cloth.cols()) = cloth;
    result.J = std::move(rows.J);
    result.stiffness = std::move(rows.stiffness);
    return result;
}

struct LinearisedSolver::Parts {
    const Zone& zone;
    std::size_t contact_count;
    FreeCoordinates free;
    Rows rows;
    MatrixX cloth;
    std::optional<InertiaFactor> factor;  // for qr

    Parts(const Zone& z, const ZonePoint& point)
        : zone(z),
          contact_count(point.active.size()),
          free(z),
          rows(collect_rows(z, point, free)),
          cloth(cloth_matrix(z, point, free)) {}
};

LinearisedSolver::LinearisedSolver(const Zone& zone, const ZonePoint& point, AdjointMode mode)
    : m_parts(std::make_unique<Parts>(zone, point)) {
    if (mode == AdjointMode::qr) m_parts->factor.emplace(zone, m_parts->cloth);
}
LinearisedSolver::~LinearisedSolver() = default;

KktSolution LinearisedSolver::solve(const Coordinates& upstream) const {
    const Parts& p = *m_parts;
    KktSolution solution = p.factor ? solve_qr(p.free, *p.factor, p.rows, upstream)
                                    : solve_dense(p.zone, p.free, p.cloth, p.rows, upstream);
    solution.multipliers = p.rows.of_contacts(solution.multipliers, p.contact_count);
    return solution;
}

}  // namespace diffsim
