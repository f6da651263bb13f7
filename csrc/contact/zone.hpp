#pragma once

#include <vector>

#include "contact/block_system.hpp"
#include "contact/contact.hpp"

/// An impact zone: bodies that may touch during a step, solved together.
///
/// Each body has six coordinates y = (theta, u) around its pose (R0, t0) at the start of the step: R = Exp(theta) R0,
/// t = t0 + u. Positions are kept relative to the zone's origin, so that rounding does not grow with the distance
/// from the world's. The step is the minimiser of [Qiao et al. 2020, Eq. 6, with contact as an energy]
///     E(y) = ½ (y - ŷ)ᵀ M (y - ŷ) + Σ contact energies,   M = diag(R0 I_b R0ᵀ, m 1).
namespace diffsim {

using Coordinates = std::vector<Vec6>;  ///< one (theta, u) per body of a zone

struct ZoneBody {
    int id = 0;                   ///< index into Model::bodies
    Pose start;                   ///< at the start of the step, zone frame
    Mat3 inertia = Mat3::Zero();  ///< R0 I_b R0ᵀ; dynamic bodies only
    Mat3 inverse_inertia = Mat3::Zero();
    double mass = kInfinity;     ///< infinite for bodies that do not yield
    Vec6 target = Vec6::Zero();  ///< ŷ: where a dynamic body goes when nothing touches it, a kinematic one is driven
    Vec6 warm = Vec6::Zero();    ///< last step's motion: dt (w0, v0)
};

/// A body that other bodies cannot move, in the world frame.
struct PassiveBody {
    int id;
    Pose start;
    Vec6 target;  ///< zero for a static body
};

/// All bodies of a scene that do not yield, with a tree over the space they sweep during the step.
struct PassiveBodies {
    std::vector<PassiveBody> bodies;
    BoxTree tree;  ///< over boxes inflated by the bodies' margins, world frame
};

struct ZoneContact {
    Contact contact;
    int a, b;  ///< indices into Zone::bodies; b is kGround with the ground
    int pair;  ///< block of the Hessian, or -1 when one of the two does not yield
    ContactRange range;
    ContactStiffness stiffness;
    double shift = 0.0;  ///< of range.rest, so that a hard contact's force acts at its rest distance [m]
};

/// Bodies (the dynamic ones first) and the contacts that can become active.
struct Zone {
    const Model* model = nullptr;
    double compliance = 0.0;     ///< of the contacts; with `hard`, of the steps towards their multipliers
    bool hard = false;           ///< contacts do not give way: Eq. 6 as written
    Vec3 origin = Vec3::Zero();  ///< of the zone frame, world
    double ground_height = 0.0;  ///< zone frame
    std::vector<ZoneBody> bodies;
    int dynamic_count = 0;
    std::vector<ZoneContact> contacts;
    std::vector<std::pair<int, int>> pairs;  ///< of dynamic bodies with contacts

    const CollisionMesh& mesh(int body) const { return model->bodies[bodies[body].id].mesh; }
    int body_count() const { return static_cast<int>(bodies.size()); }
};

/// Compliance 0 asks for hard contacts.
inline void set_compliance(Zone& zone, double compliance) {
    zone.hard = compliance == 0.0;
    zone.compliance = zone.hard ? kDefaultCompliance : compliance;
}

/// Pose of a body at its coordinates.
Pose pose_at(const ZoneBody& body, const Vec6& y);

/// Widen the range of contacts whose objects start the step next to their pole; see rescued_range.
void rescue_contacts(Zone& zone);

/// A contact below its rest distance.
struct ActiveContact {
    int index;  ///< into Zone::contacts
    ContactGeometry geometry;
};

/// The zone at some coordinates: poses, distances, energy.
struct ZonePoint {
    Coordinates y;
    std::vector<Pose> poses;
    std::vector<double> distances;  ///< one per contact
    std::vector<ActiveContact> active;
    double energy = 0.0;          ///< infinite at or below a pole
    double contact_energy = 0.0;  ///< the contacts' part
};

void evaluate(const Zone& zone, ZonePoint& point);

/// How the second derivative is taken.
enum class Curvature {
    none,       ///< gradient only
    exact,      ///< the Hessian
    projected,  ///< every contact's part made positive semidefinite: a descent direction always
    dropped     ///< contacts are rows of constant direction (the paper's linearised constraint)
};

struct ZoneDerivatives {
    Coordinates gradient;
    std::vector<Vec3> torque;  ///< world-frame gradient with respect to turns, contacts only
    double largest_force;      ///< of a single contact on a single body, in units of |L⁻¹ g|, M = L Lᵀ
    double largest_stiffness;  ///< sum over a body's contacts, in units of |L⁻¹ dg/dx|
};

/// Gradient and Hessian of the energy at an evaluated point. `system` must have the zone's pattern.
void differentiate(
    const Zone& zone, const ZonePoint& point, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system);

/// d(twist)/dy of a body at theta: turns by the left Jacobian, shifts unchanged.
Mat6 chart_jacobian(const Vec6& y);

/// Second derivative of the chart itself: what turning contributes to the Hessian for a contact torque.
Mat3 chart_curvature(const Vec6& y, const Vec3& torque);

}  // namespace diffsim
