#pragma once

#include "contact/contact.hpp"

/// Derivatives of a contact's energy.
///
/// Of a rigid body they are taken along its twist at its current pose, (turn, shift): a turn phi moves
/// x -> Exp(phi) (x - t) + t about the centre of mass t. Second derivatives are those of this chart at phi = 0, hence
/// symmetric. Of cloth they are taken along the three nodes of a feature; an edge and a vertex use the first two and
/// the first.
namespace diffsim {

/// A contact on a rigid body.
struct BodySide {
    static constexpr int kSize = 6;
    Vec3 center;  ///< of mass, in the frame of the contact's points
};

/// A contact on a feature of a cloth.
struct ClothSide {
    static constexpr int kSize = 9;
    Vec3 weights = Vec3::Zero();                               ///< of the nodes in the closest point
    std::array<Vec3, 2> slide = {Vec3::Zero(), Vec3::Zero()};  ///< their rates when the point slides
    double edge_length = 0.0;                                  ///< of an edge
};

/// What a cloth's feature contributes to a contact: where on it the closest point lies.
ClothSide cloth_side(const Contact& contact, const ContactGeometry& geometry, const Surface& cloth, bool of_a);

template <int N>
using Vector = Eigen::Matrix<double, N, 1>;
template <int N>
using Square = Eigen::Matrix<double, N, N>;

/// The energy's first and second derivatives along the coordinates of a and of b.
template <int N>
struct ContactDerivatives {
    Vector<N> gradient;  ///< minus the force on each coordinate, times step²
    Square<N> hessian;
    Vector<N> row;     ///< the distance's gradient: the contact's row in the paper's J
    double force;      ///< along the row [kg·m]
    double stiffness;  ///< along the row, of the (mollified) potential [kg]
};

/// Derivative of the distance.
template <class A, class B>
Vector<A::kSize + B::kSize> distance_gradient(const ContactGeometry& geometry, const A& a, const B& b);

/// Energy of a contact: mollifier times potential of the compression below the rest distance.
double contact_energy(const ContactGeometry& geometry, const ContactRange& range, double stiffness);

/// `with_curvature` false leaves the second derivative of distance and mollifier out of the Hessian, which is then
/// stiffness * row rowᵀ. `with_hessian` false leaves the Hessian unset.
template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_derivatives(
    const ContactGeometry& geometry, const ContactRange& range, double stiffness, const A& a, const B& b,
    bool with_hessian, bool with_curvature);

/// The same for a vertex of a rigid body above the ground, where they are short.
struct GroundDerivatives {
    Vec6 row;  ///< of the height, along the twist
    Mat6 hessian;
    double force, stiffness;
};
GroundDerivatives ground_derivatives(
    double height, const Vec3& arm, const ContactRange& range, double stiffness, bool with_hessian,
    bool with_curvature);

}  // namespace diffsim
