#pragma once

#include <memory>

#include "zone/zone_point.hpp"

/// The zone as the paper linearises it: contacts are rows of constant direction.
namespace diffsim {

/// What dense and qr solve, (A + Jᵀ K J) z = v, over the free coordinates: six per dynamic body, three per node that is
/// not pinned. The same as the KKT system of [Qiao et al. 2020, Eq. 9] with the compliance
/// 1/K as its lower right block.
struct LinearisedZone {
    std::vector<int> bodies;  ///< whose coordinates they are: indices into Model::bodies
    std::vector<int> nodes;   ///< and cloth nodes of the scene
    MatrixX inertia;          ///< A: inertia of bodies, inertia and elasticity of nodes, n x n
    MatrixX J;                ///< the active contacts, m x n
    VectorX stiffness;        ///< K of each contact, m [kg]
};

/// `zone` and `point` as for zone_adjoint.
LinearisedZone linearise(const Zone& zone, const ZonePoint& point);

/// Of [ A  Jᵀ ; J  -1/stiffness ] [z; λ] = [v; 0], A inertia and elasticity [Qiao et al. 2020, Eq. 9, its constraint
/// rows softened]. λ is stiffness J z, but computed from that it would lose the digits by which J z is smaller than z.
struct KktSolution {
    Coordinates z;
    VectorX multipliers;
};

/// Solves it, for one zone at its solution.
class LinearisedSolver {
public:
    /// `mode`: dense or qr.
    LinearisedSolver(const Zone& zone, const ZonePoint& point, AdjointMode mode);
    ~LinearisedSolver();
    KktSolution solve(const Coordinates& upstream) const;

private:
    struct Parts;
    std::unique_ptr<Parts> m_parts;
};

}  // namespace diffsim
