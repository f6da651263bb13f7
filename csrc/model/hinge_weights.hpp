#pragma once

#include <array>
#include <vector>

#include "math/types.hpp"

/// How stiff the hinges of a sheet are, each by itself and together, so that the sheet bends as a plate does.
///
/// The bending energy is quadratic in the angles θ by which the hinges are bent: ½ bend Σ_ij W_ij θ_i θ_j. A plate of
/// Poisson's ratio 0 has ½ bend |κ|² per area (Frobenius norm of the curvature tensor κ), and
///   W = Σ_T A_T B_Tᵀ B_T   from a constant tensor on each triangle T,   κ_T = B_T θ,
/// found from how the slope across each edge changes from the triangle to the edge's middle:
///   κ_T = Σ_e (l_e / A_T) (½ θ_e ± φ_e) n_e n_eᵀ,   l the edge's length, n its normal in the triangle's plane.
/// Half of the angle on either side, φ = 0, is the element of [onate2000rotation]; summed over the mesh, A_T κ_T is the
/// curvature that all hinges hold, whatever φ, which enters with opposite signs on the two sides of an edge. But on a
/// surface of constant curvature the middle has the mean slope of the two sides only where these are each other's
/// image under half a turn; elsewhere κ_T would be off, by 10 % on good irregular meshes, by 100 % in the twist of
/// grids with alternating diagonals. So φ is what the middle's slope differs from the mean by, on the surface
/// of constant curvature that comes nearest to the angles of the (up to five) hinges of the two triangles. κ_T is then
/// exact for constant curvature on any flat mesh. Where both hold, W θ gives the moments of constant curvature exactly,
/// and the sheet has no way to yield to them by folding, as hinges without couplings have.
///
/// An edge of one triangle has no hinge: the slope there is free, and goes where it costs least.
namespace diffsim {

/// Off-diagonal entry W_ab = W_ba.
struct HingeCoupling {
    int a, b;       ///< hinges, a < b
    double weight;  ///< [1]
};

struct HingeWeights {
    std::vector<double> diagonal;          ///< one per hinge [1]
    std::vector<HingeCoupling> couplings;  ///< sorted by a, then b
};

/// A hinge at rest: nodes as in ClothHinge, and the triangles with the corners nodes[2] and nodes[3]. Its angle has the
/// sign that geometry/dihedral.hpp gives it, from the order of the nodes alone; W accounts for that.
struct RestHinge {
    std::array<int, 4> nodes;
    std::array<int, 2> triangles;
};

/// Needs triangles with area. Only lengths and angles within the triangles count, not the angles between them.
HingeWeights hinge_weights(
    const std::vector<Vec3>& rest, const std::vector<std::array<int, 3>>& triangles,
    const std::vector<RestHinge>& hinges);

}  // namespace diffsim
