#pragma once

#include "adjoint/adjoint.hpp"
#include "zone/friction_row.hpp"
#include "zone/friction_term.hpp"
#include "zone/side_matrices.hpp"

/// Friction in the backward of a zone.
///
/// With K = H + Σ d(Jᵀ λ)/dy, C the slips of sticking contacts and B their forces, the solution changes by
///     K dy + B dλ = -dF,  C dy = -ds.
/// K is not symmetric, and C is not Bᵀ, since contacts move with what they touch. The transpose,
///     Kᵀ z + Cᵀ ζ = v,  Bᵀ z = 0,
/// is solved by GMRES for z and ζ together, with the factor of a symmetric matrix: H, what of friction is symmetric,
/// and springs along the slips of sticking contacts. Rows that depend on each other leave ζ open: each round gives the
/// second equation a little of ζ, and the next one takes the error that this makes. Features that meet in one point
/// slip alike, and have one ζ.
namespace diffsim {

class FrictionAdjoint {
public:
    /// `friction`: one per active contact; empty in zones without.
    FrictionAdjoint(const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>& friction);

    bool empty() const { return m_terms.empty(); }

    /// Overwrite the upstream gradient v by z. `system` holds H, whose factor is not made yet, and is used up. False
    /// where it is not positive definite even with friction.
    bool solve(BlockSystem& system, Coordinates& z);

    /// H z: the upstream gradient without what friction takes of it.
    Coordinates left_by_friction(const Coordinates& upstream, const Coordinates& z) const;

    /// What friction adds to the gradients of places, motions that are given, masses and coefficients.
    void add_gradients(const Coordinates& z, ZoneAdjoint& result) const;

private:
    struct Term : FrictionTerm {
        int contact = 0;                 ///< index into Zone::contacts
        bool holds = false;              ///< sticks, as the first of those that meet in one point
        double stiffness_held = 0.0;     ///< of all of these [kg]
        double spring = 0.0;             ///< where it holds: of the system along its slip
        Vec2 multiplier = Vec2::Zero();  ///< ζ
    };
    struct Unknowns {
        Coordinates z;
        std::vector<Vec2> multipliers;  ///< of terms that hold

        friend void add(double factor, const Unknowns& x, Unknowns& sum) {
            add(factor, x.z, sum.z);
            for (std::size_t k = 0; k < x.multipliers.size(); ++k) sum.multipliers[k] += factor * x.multipliers[k];
        }
        friend void scale(double factor, Unknowns& x) {
            scale(factor, x.z);
            for (Vec2& value : x.multipliers) value *= factor;
        }
        friend int count(const Unknowns& x) { return count(x.z) + 2 * static_cast<int>(x.multipliers.size()); }
    };

    void find_held();
    bool factorize(BlockSystem& system);
    Unknowns preconditioned(const BlockSystem& system, const Unknowns& x, double give) const;
    double dot(const Unknowns& x, const Unknowns& y) const;
    void add_symmetric(const Term& term, const SmallMatrix& matrix, BlockSystem& system) const;

    const Zone& m_zone;
    std::vector<Term> m_terms;
    std::vector<std::size_t> m_held;  // those that hold
    SideMatrices m_matrices;  // Kᵀ's part of friction with that of the springs, less what the system has of them
};

}  // namespace diffsim
