#pragma once

#include "contact/impact_row.hpp"

namespace diffsim {

/// min over p of ½ pᵀ A p + gᵀ p + Σ stiffness/2 max(0, missing - rowᵀ p)², by Newton's method on this piecewise
/// quadratic with exact line search. A is diagonal for bodies, their masses scaled by `mass_factor`, and `cloth` for nodes.
/// `p` holds the start, which pinned nodes keep, and receives the minimiser. Scratch: `system`, whose pattern has the
/// rows' pairs. Returns the number of Newton steps.
int solve_impact_qp(
    const Zone& zone, const Coordinates& gradient, const std::vector<double>& mass_factor, const BlockSystem* cloth,
    const std::vector<ImpactRow>& rows, BlockSystem& system, Coordinates& p);

/// The same for a zone with cloth, from the side of the rows' forces λ = stiffness · max(0, missing - row p):
///     p = A⁻¹ (Σ λ rowᵀ - g),   (R A⁻¹ Rᵀ + 1 / stiffness) λ = missing + R A⁻¹ g   over the rows that push.
/// A is factorized once, and a Newton step takes a dense system of those rows, where solve_impact_qp() has the rows in the
/// sparse system and factorizes that. Rows may be appended between calls: the next begins with the forces of the last.
class ImpactForces {
public:
    /// `cloth` is overwritten by nothing but its factor; all arguments must outlive this.
    ImpactForces(const Zone& zone, const Coordinates& gradient, BlockSystem& cloth);

    /// Begin with the forces that these rows have at a p that is nearly the solution.
    void start_from(const std::vector<ImpactRow>& rows, const Coordinates& p);

    /// False, with p as it was, where so many rows push at once that solve_impact_qp() is faster, or where rounding spoils
    /// the factors.
    bool solve(
        const std::vector<double>& mass_factor, const std::vector<ImpactRow>& rows, Coordinates& p, int& newton_steps);

private:
    void solve_cloth(Coordinates& p) const;
    Coordinates pushed(
        const std::vector<double>& mass_factor, const std::vector<ImpactRow>& rows,
        const std::vector<double>& forces) const;
    double body_product(const std::vector<double>& mass_factor, const ImpactRow& r, const ImpactRow& s) const;
    double node_product(const std::vector<ImpactRow>& rows, int r, int s);
    bool close(
        const std::vector<double>& mass_factor, const std::vector<ImpactRow>& rows, const std::vector<int>& pushing,
        const std::vector<double>& missing, std::vector<double>& forces);

    const Zone& m_zone;
    const Coordinates& m_gradient;
    BlockSystem& m_cloth;
    bool m_factorized;
    int m_most_pushing = 0;
    Coordinates m_alone;                          // -A⁻¹ g: where p is without rows
    std::vector<double> m_forces;                 // per row
    std::vector<int> m_slot;                      // of each row in the next two, -1 until it pushes
    std::vector<HalfSolution> m_halves;           // L⁻¹ rowᵀ of the nodes
    std::vector<std::vector<double>> m_products;  // of two such, the lower triangle
};

}  // namespace diffsim
