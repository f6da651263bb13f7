#pragma once

#include <optional>
#include <vector>

#include "contact/contact_derivatives.hpp"
#include "dynamics/cloth_elasticity.hpp"
#include "zone/block_system.hpp"
#include "zone/contact_set.hpp"

/// An impact zone: bodies and cloths that may touch during a step, solved together.
///
/// Each body has six coordinates y = (theta, u) around its pose (R0, t0) at the start of the step: R = Exp(theta) R0,
/// t = t0 + u. Positions are kept relative to the zone's origin, so that rounding does not grow with the distance
/// from the world's. A cloth node has the coordinates y = u around its position at the start. The step is the minimiser
/// of [Qiao et al. 2020, Eqs. 2 and 6 together, with contact as an energy]
///     E(y) = ½ (y - ŷ)ᵀ M (y - ŷ) + dt² Ψ(y) + Σ contact energies,   M = diag(R0 I_b R0ᵀ, m 1), nodes m 1,
/// with Ψ the elastic potential of the cloths (dynamics/cloth_elasticity.hpp). The scheme of second order solves it for
/// other targets, masses and strains (step/step.hpp).
namespace diffsim {

struct ZoneBody {
    int id = 0;                   ///< index into Model::bodies
    Pose start;                   ///< at the start of the step, zone frame
    Mat3 inertia = Mat3::Zero();  ///< R0 I_b R0ᵀ; dynamic bodies only
    Mat3 inverse_inertia = Mat3::Zero();
    double mass = kInfinity;  ///< infinite for bodies that do not yield
    double weight = 1.0;      ///< the mass and inertia here over the body's own, by which contacts have their stiffness
    Vec6 target = Vec6::Zero();  ///< ŷ: where a dynamic body goes when nothing touches it, a kinematic one is driven
    Vec6 last_motion = Vec6::Zero();  ///< last step's motion: dt (w0, v0)
};

/// M p
inline Vec6 mass_times(const ZoneBody& body, const Vec6& p) {
    Vec6 result;
    result << body.inertia * p.head<3>(), body.mass * p.tail<3>();
    return result;
}

/// M⁻¹ p
inline Vec6 inverse_mass_times(const ZoneBody& body, const Vec6& p) {
    Vec6 result;
    result << body.inverse_inertia * p.head<3>(), p.tail<3>() / body.mass;
    return result;
}

struct ZoneNode {
    Vec3 start = Vec3::Zero();  ///< at the start of the step, zone frame
    double mass = 0.0;
    double weight = 1.0;              ///< see ZoneBody::weight
    bool pinned = false;              ///< moves to its target whatever happens
    Vec3 target = Vec3::Zero();       ///< ŷ: dt v̂ of a free node, dt times its given velocity of a pinned one
    Vec3 last_motion = Vec3::Zero();  ///< last step's motion: dt v0
    std::optional<Vec3> guess;        ///< where the search may begin, if anything better is known than last_motion
};

/// How a step strains a cloth: the zone's energy has the term  scale Ψ(x0 + base_share (x1 - x0) + share y),  x0 where
/// the nodes start the step and x1 where they were at the end of a first stage, if the time scheme has one.
struct Straining {
    double scale = 0.0;             ///< [s²]
    double share = 1.0;             ///< [1]
    double base_share = 0.0;        ///< [1]
    std::vector<Vec3> first_stage;  ///< x1, zone frame; empty where there is none
    double time = 0.0;              ///< over which strains change from those of `start`, for damping [s]
    double start_share = 0.0;       ///< of the strains at x1 in `start`, the rest being those at x0 [1]
    ElasticStart start;             ///< strains that damping is measured from
};

/// A cloth; all its nodes are in the zone.
struct ZoneCloth {
    int id = 0;          ///< index into Model::cloths
    int first_node = 0;  ///< index into Zone::nodes
    Straining straining;
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

/// Bodies (the dynamic ones first) and the contacts that can become active.
struct Zone {
    const Model* model = nullptr;
    double compliance = 0.0;     ///< of the contacts; of exact ones, of the first step towards their multipliers
    bool exact_contact = false;  ///< contacts do not give way: Eq. 6 as written
    Vec3 origin = Vec3::Zero();  ///< of the zone frame, world
    double ground_height = 0.0;  ///< zone frame
    std::vector<ZoneBody> bodies;
    int dynamic_count = 0;
    std::vector<ZoneNode> nodes;
    std::vector<ZoneCloth> cloths;
    const std::vector<ClothParameters>* cloth_parameters = nullptr;  ///< of all cloths of the model
    const std::vector<double>* friction = nullptr;  ///< Parameters::friction; null where no pair can have any
    bool elastic = true;        ///< false: cloth is loose nodes, as in the contact pass of split coupling
    bool contacts_off = false;  ///< as in its elastic pass
    ContactSet contacts;

    const CollisionMesh& mesh(int body) const { return model->bodies[bodies[body].id].mesh; }
    int body_count() const { return static_cast<int>(bodies.size()); }
    int node_count() const { return static_cast<int>(nodes.size()); }
    const Cloth& cloth(int index) const { return model->cloths[cloths[index].id]; }
    /// Whether forces move this body; false for the ground and for nobody.
    bool yields(int body) const { return body >= 0 && body < dynamic_count; }
};

/// Have the vertices of bodies that a contact needs placed with the zone.
void list_feature_vertices(Zone& zone, const ZoneContact& contact);

/// Make an empty zone in the memory of another one, for bodies and cloths of a model to join: the one way to make a
/// zone. Compliance 0 asks for exact ones. Returns `zone`.
Zone& make_zone(
    Zone& zone, const Model& model, const std::vector<ClothParameters>& cloths, double compliance, const Vec3& origin);

/// Pose of a body at its coordinates.
Pose pose_at(const ZoneBody& body, const Vec6& y);

}  // namespace diffsim
