#pragma once

#include "adjoint/adjoint.hpp"
#include "zone/friction_term.hpp"

/// Friction in the backward of a zone.
///
/// With K = H + Σ d(Jᵀ λ)/dy, C the slips of sticking contacts and B their forces, the solution changes by
///     K dy + B dλ = -dF,  C dy = -ds.
/// K is not symmetric, and C is not Bᵀ, since contacts move with what they touch. The transpose,
///     Kᵀ z + Cᵀ ζ = v,  Bᵀ z = 0,
/// is solved by rounds of multipliers, (Kᵀ + Cᵀ k Bᵀ) z = v - Cᵀ ζ, ζ += k Bᵀ z, each by GMRES with the factor of a symmetric
/// matrix: H, and what of friction is symmetric.
namespace diffsim {

class FrictionAdjoint {
public:
    /// `friction`: one per active contact; empty in zones without.
    FrictionAdjoint(const Zone& zone, const ZonePoint& point, const std::vector<ContactFriction>& friction);

    bool empty() const { return m_terms.empty(); }

    /// Overwrite the upstream gradient v by z. `system` holds H, whose factor is not made yet, and is used up. False where it
    /// is not positive definite even with friction.
    bool solve(BlockSystem& system, Coordinates& z);

    /// H z: the upstream gradient without what friction takes of it.
    Coordinates left_by_friction(const Coordinates& upstream, const Coordinates& z) const;

    /// What friction adds to the gradients of places, motions that are given, masses and coefficients.
    void add_gradients(const Coordinates& z, ZoneAdjoint& result) const;

private:
    struct Term : FrictionTerm {
        int contact = 0;                                       ///< index into Zone::contacts
        SmallMatrix beyond;                                    ///< what the system lacks of it
        Eigen::Vector2d multiplier = Eigen::Vector2d::Zero();  ///< ζ
    };

    void add_symmetric(const Term& term, const SmallMatrix& matrix, BlockSystem& system) const;

    const Zone& m_zone;
    std::vector<Term> m_terms;
};

}  // namespace diffsim
