#pragma once

#include <utility>
#include <vector>

#include "geometry/dihedral.hpp"
#include "model/cloth.hpp"

/// The elastic potential of one cloth over one step of implicit Euler, or a stage that is one, with its derivatives.
/// Nodes are those of the cloth, from 0; pins are the caller's business.
///
/// Membrane, per triangle with deformation gradient F (3 x 2) and Green strain ε = ½ (FᵀF - 1):
///   W(ε) = ½ E / (1 - ν²) (ε11² + ε22² + 2 ν ε11 ε22) + ½ G (2 ε12)²,  times the area at rest,
/// with E = stretch, G = shear. Bending, over all pairs of hinges with dihedral angles θ and rest angles θ0:
///   ½ bend Σ W_ij (θ_i - θ0_i) (θ_j - θ0_j),  W from model/hinge_weights.hpp.
/// Kelvin–Voigt damping, as the gain damping / dt on the same two forms of the change over the step, ε - ε_start and
/// θ - θ_start, so that the step stays a minimization. Differences of angles are taken in (-π, π]: springs take the
/// shorter way round, and the energy has a kink at half a turn.
///
/// The membrane is smooth everywhere. The angle is not defined at a hinge with a triangle collapsed to a line or point:
/// while that lasts the hinge contributes nothing, and at the start of a step it counts as flat. All else is finite,
/// though a hinge's forces grow as its triangles' heights fall.
///
/// Sums run in the order of triangles, then hinges, then couplings: results depend on the input alone.
namespace diffsim {

/// Strains at the start of a step, which its damping is measured from.
struct ElasticStart {
    std::vector<Vec3> strain;   ///< per triangle: ε11, ε22, ε12 (1 warp, 2 weft) [1]
    std::vector<double> angle;  ///< per hinge [rad]
};

ElasticStart elastic_start(const Cloth& cloth, const Vec3* x_start);

/// The strains `from` and so many times how they differ at `to`.
ElasticStart extrapolated(const ElasticStart& from, const ElasticStart& to, double share);

/// [J]
double elastic_energy(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x);

/// gradient += scale * d(energy)/dx, minus the elastic forces [N].
void add_elastic_gradient(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    double scale, Vec3* gradient);

/// product += scale * (the exact Hessian) * direction.
void add_elastic_hessian_product(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    const Vec3* direction, double scale, Vec3* product);

/// Gradient of  s = scale * direction · d(energy)/dx  with respect to what the energy depends on besides x: added to
/// grad_x_start through the start's strains, and returned for the parameters (density's is 0). With respect to x
/// it is the Hessian product; with respect to dt it is -damping / dt times that with respect to damping.
/// `start` depends on x_start as elastic_start(cloth, x_start) does.
ClothParameters add_elastic_backward(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    const Vec3* x_start, const Vec3* direction, double scale, Vec3* grad_x_start);

/// How much of what can make a second derivative indefinite is cut off. kNothingCut leaves the exact one. kAllCut
/// leaves a positive semidefinite one:
///  - Triangles: blocks (∂ε/∂xi)ᵀ C (∂ε/∂xj), always semidefinite, plus (giᵀ S gj) 1 with the stress S and the
///    gradients g of the shape functions. Along the triangle's normal the latter stands alone, so that the whole is
///    semidefinite exactly when S is: the negative part of S is cut off, for a square root. Clamping the
///    eigenvalues of the 9 x 9 matrix would differ within the triangle's plane, by the cut stress beside the stiffness,
///    which is of the order of the strain.
///  - Bending: bend Σ W_ij ∇θ_i ∇θ_jᵀ, semidefinite as a sum over all hinges and couplings, plus Σ moment_i ∇²θ_i. Any
///    moment makes it indefinite, since ∇²θ couples a corner's motion along ∇θ with that away from the edge, against
///    which the hinge has no stiffness. The moments' term is cut off.
/// Clamping eigenvalues instead would take some 4 µs per triangle and 7 µs per hinge, thirty times as long or more.
/// A share between them cuts off that part of it, and is semidefinite where enough is.
using CutShare = double;
inline constexpr CutShare kNothingCut = 0.0, kAllCut = 1.0;

/// Second derivative of the energy of one triangle by its nodes' positions [N/m].
struct TriangleHessian {
    int id;                              ///< of the triangle in the cloth
    std::array<int, 3> nodes;            ///< of the cloth
    Eigen::Matrix<double, 9, 9> matrix;  ///< symmetric, in the order of the nodes

    auto block(int row, int column) const { return matrix.block<3, 3>(3 * row, 3 * column); }
};

/// The part of a hinge and of its couplings to later ones: block(r, s), in the rows of nodes[r] and the columns of
/// nodes[s], and its transpose in the rows of nodes[s], summed over r < 4 and all s.
struct HingeHessian {
    std::vector<int> nodes;     ///< of the cloth: the hinge's four, then those of other hinges
    Mat34 gradient;             ///< of the hinge's angle, ∇θ_i
    std::vector<Vec3> coupled;  ///< per node: of bend (½ W_ii ∇θ_i + Σ W_ij ∇θ_j)
    Mat12 curvature;            ///< ½ moment ∇²θ_i, what is left of it

    Mat3 block(int r, int s) const {
        Mat3 result = gradient.col(r) * coupled[s].transpose();
        if (s < 4) result += curvature.block<3, 3>(3 * r, 3 * s);
        return result;
    }
};

/// What all elements of one cloth and step have in common.
struct ElasticLaw {
    double c11, c12;         ///< of stress from ε11 and ε22 [N/m]
    double shear;            ///< [N/m]
    double bend;             ///< [N·m]
    double damping_over_dt;  ///< [1]
};

ElasticLaw elastic_law(const Cloth& cloth, const ClothParameters& parameters, double dt);

/// The hinges of a cloth as the energy's derivatives need them.
struct BentHinges {
    std::vector<DihedralFrame> frames;
    std::vector<Mat34> gradients;  ///< of the angles [rad/m]
    std::vector<double> moments;   ///< derivative of the energy by each angle [N·m]
};

BentHinges bent_hinges(const Cloth& cloth, const ElasticLaw& law, const ElasticStart& start, const Vec3* x);

TriangleHessian triangle_hessian(
    const Cloth& cloth, const ElasticLaw& law, const ElasticStart& start, const Vec3* x, int triangle, CutShare cut);

/// Of the hinge whose couplings begin at `coupling`, which is moved on to those of the next.
void set_hinge_hessian(
    const Cloth& cloth, const ElasticLaw& law, const BentHinges& bent, int hinge, CutShare cut, std::size_t& coupling,
    HingeHessian& result);

/// Call visit(element) with every TriangleHessian, then every HingeHessian.
template <class Visit>
void visit_elastic_hessian(
    const Cloth& cloth, const ClothParameters& parameters, double dt, const ElasticStart& start, const Vec3* x,
    CutShare cut, Visit&& visit) {
    const ElasticLaw law = elastic_law(cloth, parameters, dt);
    for (int t = 0; t < static_cast<int>(cloth.triangles.size()); ++t)
        visit(triangle_hessian(cloth, law, start, x, t, cut));
    const BentHinges bent = bent_hinges(cloth, law, start, x);
    HingeHessian element;
    std::size_t coupling = 0;
    for (int h = 0; h < static_cast<int>(cloth.hinges.size()); ++h) {
        set_hinge_hessian(cloth, law, bent, h, cut, coupling, element);
        visit(std::as_const(element));
    }
}

}  // namespace diffsim
