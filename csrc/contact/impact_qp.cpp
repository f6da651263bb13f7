#include "contact/impact_qp.hpp"

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>

namespace diffsim {
namespace {

constexpr int kMaxNewtonSteps = 50;
constexpr double kLineTolerance = 1e-4;  // of the step: Newton corrects the rest
constexpr double kQpTolerance = 1e-9;    // of the forces on each body: a search direction needs no more
constexpr double kFullStep = 1e-3;       // steps this near to 1 end where the rows they were made for say
// More forces at once would make a factor of their dense system dearer than one of the sparse one: by counting, n² nodes
// and 10 n rows take about as many operations.
constexpr double kPushingPerRootNode = 10.0;
constexpr double kUnknown = std::numeric_limits<double>::quiet_NaN();

double dot(const Coordinates& a, const Coordinates& b, int body_count) {
    double sum = 0.0;
    for (int i = 0; i < body_count; ++i) sum += a.bodies[i].dot(b.bodies[i]);
    for (std::size_t i = 0; i < a.nodes.size(); ++i) sum += a.nodes[i].dot(b.nodes[i]);
    return sum;
}

/// The quadratic part of the QP times p; nothing for pinned nodes.
void model_times(
    const Zone& zone, const std::vector<double>& mass_factor, const BlockSystem* cloth, const Coordinates& p,
    Coordinates& out) {
    if (cloth != nullptr) {
        cloth->multiply(p, out);
        for (int i = 0; i < zone.node_count(); ++i)
            if (zone.nodes[i].pinned) out.nodes[i].setZero();
    }
    out.bodies.resize(static_cast<std::size_t>(zone.dynamic_count));
    for (int i = 0; i < zone.dynamic_count; ++i)
        out.bodies[i] = mass_factor[i] * mass_times(zone.bodies[i], p.bodies[i]);
}

/// Minimise the convex piecewise quadratic t -> f(p + t s) for t > 0: Newton with bisection as its guard.
double exact_line_search(
    const std::vector<double>& violation, const std::vector<double>& slope, const std::vector<ImpactRow>& rows,
    double first, double second) {
    double lower = 0.0, upper = kInfinity, t = 1.0;
    for (int k = 0; k < 60; ++k) {
        double derivative = first + t * second, curvature = second;
        for (std::size_t r = 0; r < rows.size(); ++r) {
            const double v = violation[r] - t * slope[r];
            if (v <= 0.0) continue;
            derivative -= rows[r].stiffness * v * slope[r];
            curvature += rows[r].stiffness * slope[r] * slope[r];
        }
        (derivative > 0.0 ? upper : lower) = t;
        double next = t - derivative / curvature;
        if (!(next > lower && next < upper)) next = upper < kInfinity ? 0.5 * (lower + upper) : 2.0 * t;
        if (std::abs(next - t) <= kLineTolerance * t) break;
        t = next;
    }
    return t;
}

/// The QP's matrix without rows, of the nodes: mass and, pattern by pattern, elasticity.
void add_cloth_model(const Zone& zone, const BlockSystem& cloth, BlockSystem& system) {
    for (int i = 0; i < zone.node_count(); ++i) system.node_diagonal(i) = cloth.node_diagonal(i);
    const IndexPairs& pairs = cloth.pattern().node_pairs;
    for (std::size_t k = 0; k < pairs.size(); ++k)
        system.node_pair(system.find_node_pair(pairs[k].first, pairs[k].second)) = cloth.node_pair(static_cast<int>(k));
}

/// The part of a row's stiffness that nodes take part in.
void add_node_stiffness(const Zone& zone, const ImpactRow& row, BlockSystem& system) {
    for (std::size_t k = 0; k < row.nodes.size(); ++k) {
        const int node = row.nodes[k];
        for (std::size_t l = k; l < row.nodes.size(); ++l)
            add_node_block(
                zone, node, row.nodes[l], row.stiffness * row.node_rows[k] * row.node_rows[l].transpose(), system);
        if (row.a >= 0)
            system.mixed_pair(system.find_mixed_pair(row.a, node)) +=
                row.stiffness * row.row_a() * row.node_rows[k].transpose();
    }
}

/// What the rows of two bodies do to them together.
void add_run(
    const ImpactRow& row, const Vector<9>& force, const Square<9>& stiffness, Coordinates& gradient,
    BlockSystem& system) {
    const Vector<12> forces = both_twists(force);
    const Square<12> blocks = both_twists(stiffness);
    if (row.a >= 0) {
        gradient.bodies[row.a] -= forces.head<6>();
        system.diagonal(row.a) += blocks.topLeftCorner<6, 6>();
    }
    if (row.b >= 0) {
        gradient.bodies[row.b] -= forces.tail<6>();
        system.diagonal(row.b) += blocks.bottomRightCorner<6, 6>();
    }
    if (row.a >= 0 && row.b >= 0) system.off_diagonal(row.pair) += blocks.topRightCorner<6, 6>();
}

/// The forces that cancel on each body and node of a QP: sums of their sizes.
class ForceSizes {
public:
    ForceSizes(int body_count, int node_count) : m_body_count(body_count) {
        m_sizes.resize(static_cast<std::size_t>(body_count + node_count));
    }
    void start(const Coordinates& one, const Coordinates& other) {
        for (std::size_t i = 0; i < m_sizes.size(); ++i) m_sizes[i] = part(one, i) + part(other, i);
    }
    void add(const ImpactRow& row, double force) {
        const double shift_sq = row.relative.tail<3>().squaredNorm();
        if (row.a >= 0) m_sizes[row.a] += force * std::sqrt(row.relative.head<3>().squaredNorm() + shift_sq);
        if (row.b >= 0) m_sizes[row.b] += force * std::sqrt(row.relative.segment<3>(3).squaredNorm() + shift_sq);
        for (std::size_t k = 0; k < row.nodes.size(); ++k)
            m_sizes[static_cast<std::size_t>(m_body_count + row.nodes[k])] += force * row.node_rows[k].norm();
    }
    bool balanced(const Coordinates& gradient) const {
        for (std::size_t i = 0; i < m_sizes.size(); ++i)
            if (!(part(gradient, i) <= kQpTolerance * m_sizes[i])) return false;
        return true;
    }

private:
    double part(const Coordinates& sum, std::size_t i) const {
        const std::size_t bodies = static_cast<std::size_t>(m_body_count);
        return i < bodies ? sum.bodies[i].norm() : sum.nodes[i - bodies].norm();
    }

    int m_body_count;
    std::vector<double> m_sizes;
};

}  // namespace

int solve_impact_qp(
    const Zone& zone, const Coordinates& model_gradient, const std::vector<double>& mass_factor,
    const BlockSystem* cloth, const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p) {
    const int count = zone.dynamic_count;
    Coordinates gradient, step, model_step;
    gradient.assign_zero(static_cast<std::size_t>(count), zone.nodes.size());
    step = gradient;
    std::vector<double> violation(rows.size()), slope(rows.size());
    ForceSizes sizes(count, zone.node_count());
    int k = 0;
    for (; k < kMaxNewtonSteps; ++k) {
        system.set_zero();
        model_times(zone, mass_factor, cloth, p, gradient);
        sizes.start(gradient, model_gradient);
        for (int i = 0; i < count; ++i) {
            const ZoneBody& body = zone.bodies[i];
            gradient.bodies[i] += model_gradient.bodies[i];
            system.diagonal(i).topLeftCorner<3, 3>() = mass_factor[i] * body.inertia;
            system.diagonal(i).diagonal().tail<3>().setConstant(mass_factor[i] * body.mass);
        }
        for (int i = 0; i < zone.node_count(); ++i) gradient.nodes[i] += model_gradient.nodes[i];
        if (cloth != nullptr) add_cloth_model(zone, *cloth, system);
        rows_times(rows, p, violation);
        visit_runs(rows, [&](std::size_t first, std::size_t last) {
            Vector<9> force = Vector<9>::Zero();
            HalfSymmetric<9> stiffness;
            for (std::size_t r = first; r < last; ++r) {
                const ImpactRow& row = rows[r];
                violation[r] = row.missing - violation[r];
                if (!(violation[r] > 0.0)) continue;
                const double push = row.stiffness * violation[r];
                force += push * row.relative;
                stiffness.add_square(row.stiffness, row.relative);
                sizes.add(row, push);
                for (std::size_t n = 0; n < row.nodes.size(); ++n)
                    gradient.nodes[row.nodes[n]] -= push * row.node_rows[n];
                add_node_stiffness(zone, row, system);
            }
            add_run(rows[first], force, stiffness.whole(), gradient, system);
        });
        if (sizes.balanced(gradient)) break;
        if (!system.factorize()) break;
        for (int i = 0; i < count; ++i) step.bodies[i] = -gradient.bodies[i];
        for (int i = 0; i < zone.node_count(); ++i) step.nodes[i] = -gradient.nodes[i];
        system.solve_in_place(step);
        rows_times(rows, step, slope);
        // Slope and curvature of the quadratic part along the step.
        model_times(zone, mass_factor, cloth, step, model_step);
        const double first = dot(step, model_gradient, count) + dot(model_step, p, count);
        const double second = dot(model_step, step, count);
        if (!(second > 0.0)) break;
        const double t = exact_line_search(violation, slope, rows, first, second);
        for (int i = 0; i < count; ++i) p.bodies[i] += t * step.bodies[i];
        for (int i = 0; i < zone.node_count(); ++i) p.nodes[i] += t * step.nodes[i];
    }
    return k;
}

ImpactForces::ImpactForces(const Zone& zone, const Coordinates& gradient, BlockSystem& cloth)
    : m_zone(zone), m_gradient(gradient), m_cloth(cloth), m_factorized(cloth.factorize()) {
    if (!m_factorized) return;
    m_alone.bodies.resize(gradient.bodies.size());
    m_alone.nodes = gradient.nodes;
    solve_cloth(m_alone);
    for (Vec3& node : m_alone.nodes) node = -node;
    m_most_pushing = static_cast<int>(kPushingPerRootNode * std::sqrt(static_cast<double>(zone.node_count())));
}

/// A⁻¹ of the nodes, whose numbers it takes from and leaves in p.
void ImpactForces::solve_cloth(Coordinates& p) const {
    Coordinates nodes;
    nodes.nodes.swap(p.nodes);
    m_cloth.solve_in_place(nodes);
    p.nodes.swap(nodes.nodes);
}

/// A⁻¹ Rᵀ forces
Coordinates ImpactForces::pushed(
    const std::vector<double>& mass_factor, const std::vector<ImpactRow>& rows,
    const std::vector<double>& forces) const {
    Coordinates p;
    p.assign_zero(mass_factor.size(), m_zone.nodes.size());
    for (std::size_t r = 0; r < rows.size(); ++r)
        if (forces[r] != 0.0) add_row(rows[r], forces[r], p);
    for (std::size_t i = 0; i < mass_factor.size(); ++i)
        p.bodies[i] = inverse_mass_times(m_zone.bodies[i], p.bodies[i]) / mass_factor[i];
    solve_cloth(p);
    return p;
}

/// rᵀ A⁻¹ s of two rows, the bodies' part.
double ImpactForces::body_product(
    const std::vector<double>& mass_factor, const ImpactRow& r, const ImpactRow& s) const {
    double sum = 0.0;
    const auto add = [&](int body, const Vec6& row, int other, const Vec6& other_row) {
        if (body < 0 || body != other) return;
        sum += row.dot(inverse_mass_times(m_zone.bodies[body], other_row)) / mass_factor[body];
    };
    add(r.a, r.row_a(), s.a, s.row_a());
    add(r.a, r.row_a(), s.b, s.row_b());
    add(r.b, r.row_b(), s.a, s.row_a());
    add(r.b, r.row_b(), s.b, s.row_b());
    return sum;
}

/// The nodes' part, of rows by number; computed when first asked for.
double ImpactForces::node_product(const std::vector<ImpactRow>& rows, int r, int s) {
    for (const int row : {r, s}) {
        if (m_slot[row] >= 0) continue;
        m_slot[row] = static_cast<int>(m_halves.size());
        m_halves.push_back(m_cloth.half_solve(rows[row].nodes, rows[row].node_rows));
    }
    const int a = std::max(m_slot[r], m_slot[s]), b = std::min(m_slot[r], m_slot[s]);
    while (static_cast<int>(m_products.size()) <= a) m_products.emplace_back(m_products.size() + 1, kUnknown);
    double& product = m_products[a][b];
    if (std::isnan(product)) product = m_halves[a].dot(m_halves[b]);
    return product;
}

/// The forces that close exactly these rows' violations, softened by their stiffness.
bool ImpactForces::close(
    const std::vector<double>& mass_factor, const std::vector<ImpactRow>& rows, const std::vector<int>& pushing,
    const std::vector<double>& missing, std::vector<double>& forces) {
    const Eigen::Index count = static_cast<Eigen::Index>(pushing.size());
    MatrixX compliance(count, count);
    VectorX wanted(count);
    for (Eigen::Index i = 0; i < count; ++i) {
        const int r = pushing[static_cast<std::size_t>(i)];
        for (Eigen::Index j = 0; j <= i; ++j) {
            const int s = pushing[static_cast<std::size_t>(j)];
            compliance(i, j) = node_product(rows, r, s) + body_product(mass_factor, rows[r], rows[s]);
        }
        compliance(i, i) += 1.0 / rows[r].stiffness;
        wanted[i] = missing[r];
    }
    const Eigen::LLT<MatrixX> factor(compliance);
    if (factor.info() != Eigen::Success) return false;
    wanted = factor.solve(wanted);
    std::fill(forces.begin(), forces.end(), 0.0);
    for (Eigen::Index i = 0; i < count; ++i) forces[pushing[static_cast<std::size_t>(i)]] = wanted[i];
    return wanted.allFinite();
}

void ImpactForces::start_from(const std::vector<ImpactRow>& rows, const Coordinates& p) {
    m_forces.clear();
    for (const ImpactRow& row : rows)
        m_forces.push_back(row.stiffness * std::max(0.0, row.missing - row_times(row, p)));
}

bool ImpactForces::solve(
    const std::vector<double>& mass_factor, const std::vector<ImpactRow>& rows, Coordinates& p, int& newton_steps) {
    if (!m_factorized) return false;
    const std::size_t count = rows.size();
    m_forces.resize(count, 0.0);
    m_slot.resize(count, -1);
    for (std::size_t i = 0; i < mass_factor.size(); ++i)
        m_alone.bodies[i] = -inverse_mass_times(m_zone.bodies[i], m_gradient.bodies[i]) / mass_factor[i];

    Coordinates now = pushed(mass_factor, rows, m_forces);
    std::vector<double> missing(count), violation(count), slope(count), next(count);
    for (std::size_t r = 0; r < count; ++r) {
        missing[r] = rows[r].missing - row_times(rows[r], m_alone);
        violation[r] = missing[r] - row_times(rows[r], now);
    }
    std::vector<int> pushing, pushed_before;
    double t = 0.0;
    for (newton_steps = 0; newton_steps < kMaxNewtonSteps; ++newton_steps) {
        pushing.clear();
        for (std::size_t r = 0; r < count; ++r)
            if (violation[r] > 0.0) pushing.push_back(static_cast<int>(r));
        if (t == 1.0 && pushing == pushed_before) break;
        if (static_cast<int>(pushing.size()) > m_most_pushing) return false;
        if (!close(mass_factor, rows, pushing, missing, next)) return false;
        double change = 0.0, largest = 0.0;
        for (std::size_t r = 0; r < count; ++r) {
            largest = std::max(largest, next[r]);
            next[r] -= m_forces[r];
            change = std::max(change, std::abs(next[r]));
        }
        if (!(change > kQpTolerance * largest)) break;
        const Coordinates step = pushed(mass_factor, rows, next);
        double first = 0.0, second = 0.0;
        for (std::size_t r = 0; r < count; ++r) {
            slope[r] = row_times(rows[r], step);
            first += m_forces[r] * slope[r];
            second += next[r] * slope[r];
        }
        if (!(second > 0.0)) break;
        t = exact_line_search(violation, slope, rows, first, second);
        if (std::abs(t - 1.0) < kFullStep) t = 1.0;
        for (std::size_t r = 0; r < count; ++r) {
            m_forces[r] += t * next[r];
            violation[r] -= t * slope[r];
        }
        for (std::size_t i = 0; i < now.bodies.size(); ++i) now.bodies[i] += t * step.bodies[i];
        for (std::size_t i = 0; i < now.nodes.size(); ++i) now.nodes[i] += t * step.nodes[i];
        pushed_before = pushing;
    }
    for (std::size_t i = 0; i < now.bodies.size(); ++i) p.bodies[i] = m_alone.bodies[i] + now.bodies[i];
    for (int i = 0; i < m_zone.node_count(); ++i)
        if (!m_zone.nodes[i].pinned) p.nodes[i] = m_alone.nodes[i] + now.nodes[i];
    return true;
}

}  // namespace diffsim
