#pragma once

#include "contact/sides.hpp"
#include "math/half_symmetric.hpp"

/// Derivatives of a contact's energy along the coordinates of its two sides. Second derivatives of a body are those of
/// its twist's chart at phi = 0, hence symmetric.
namespace diffsim {

/// The energy's first derivative along the coordinates of a and of b, and what it is made of.
template <int N>
struct ContactForce {
    Vector<N> gradient;  ///< minus the force on each coordinate, times step²
    Vector<N> row;       ///< the distance's gradient: the contact's row in the paper's J
    double force;        ///< along the row [kg·m]
    double stiffness;    ///< along the row, of the (mollified) potential [kg]
};

/// With the second.
template <int N>
struct ContactDerivatives : ContactForce<N> {
    Square<N> hessian;
};

/// Energy of a contact: mollifier times potential of the compression below the rest distance.
double contact_energy(const ContactGeometry& geometry, const ContactLaw& law);

/// What it pushes with, along its normal.
double contact_force(const ContactGeometry& geometry, const ContactLaw& law);

/// `with_curvature` false leaves the second derivative of distance and mollifier out of the Hessian, which is then
/// stiffness * row rowᵀ. `with_hessian` false leaves the Hessian unset.
template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_derivatives(
    const ContactGeometry& geometry, const ContactLaw& law, const A& a, const B& b, bool with_hessian,
    bool with_curvature);

/// The same of two bodies along (turn of a, turn of b, shift of b against a), all that matters. The second derivative
/// is added to `hessian`, unless that is null.
ContactForce<9> add_relative_derivatives(
    const ContactGeometry& geometry, const ContactLaw& law, const BodySide& a, const BodySide& b, bool with_curvature,
    HalfSymmetric<9>* hessian);

/// The same for a contact that pushes with a force of its own, whatever its distance, as a row of a ContactModel does:
/// the second derivative is -force d²(distance).
ContactForce<9> add_relative_curvature(
    const ContactGeometry& geometry, double force, const BodySide& a, const BodySide& b, HalfSymmetric<9>& hessian);
template <class A, class B>
ContactDerivatives<A::kSize + B::kSize> contact_curvature(
    const ContactGeometry& geometry, double force, const A& a, const B& b);

/// From there to the twists of a and of b.
Vector<12> both_twists(const Vector<9>& relative);
Square<12> both_twists(const Square<9>& relative);

/// The same of a rigid body's vertices above the ground, where they are short: of all its contacts together.
class GroundSums {
public:
    /// Of the height, along the twist, for a vertex with this arm from the centre of mass.
    static Vec6 row(const Vec3& arm);
    /// One more vertex. Returns its energy with respect to its compression.
    PotentialValue add(double height, const Vec3& arm, const ContactLaw& law);

    /// One that pushes with a force of its own.
    void add_force(double force, const Vec3& arm) {
        m_force += force;
        m_force_arm += force * arm;
    }

    Vec6 gradient() const;
    Mat6 hessian(bool with_curvature) const;

private:
    double m_force = 0.0;
    Vec3 m_force_arm = Vec3::Zero();  // sum of force * arm
    Vec6 m_moments = Vec6::Zero();    // sums of stiffness * (1, x, y, xx, xy, yy), arm = (x, y, z)
};

}  // namespace diffsim
