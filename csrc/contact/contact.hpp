#pragma once

#include "collision/candidates.hpp"
#include "contact/potential.hpp"
#include "geometry/distance.hpp"
#include "model/model.hpp"

/// One contact: a pair of features of two objects, its distance, and the derivatives of its energy.
///
/// Derivatives are taken along twists of the bodies at their current poses, in the order (turn of a, shift of a,
/// turn of b, shift of b): a turn phi moves x -> Exp(phi) (x - t) + t about the centre of mass t. Second derivatives
/// are those of this chart at phi = 0, hence symmetric.
namespace diffsim {

struct CcdOptions;

using Vec12 = Eigen::Matrix<double, 12, 1>;
using Mat12 = Eigen::Matrix<double, 12, 12>;

/// Which features of which objects. Indices into Model::bodies, or kGround for object_b.
struct Contact {
    int object_a, object_b;
    ContactType type;          ///< vertex_patch with the ground
    int feature_a, feature_b;  ///< feature_b is -1 with the ground

    bool with_ground() const { return object_b == kGround; }
};

struct ContactGeometry {
    double distance;                ///< between the bare meshes, margins not taken off [m]
    Vec3 normal;                    ///< unit, from b to a
    ClosestPoints closest;          ///< in world axes
    double sine_sq = 1.0;           ///< of the angle between two edges; 1 for other pairs
    Vec3 direction_a, direction_b;  ///< unit directions of the two edges, set where sine_sq < kParallelLimit
};

/// Distance and all that its derivatives need, with the two objects at these poses. `ground_height` is the ground's
/// in the frame of the poses; pose_b is not used with the ground.
ContactGeometry contact_geometry(
    const Model& model, const Contact& contact, const Pose& pose_a, const Pose& pose_b, double ground_height);

/// Time of impact in [0, 1] of a contact whose objects' vertices move on straight lines, or kNoImpact. Keeps the
/// distance above `options.min_distance`.
double contact_toi(
    const Model& model, const Contact& contact, const Sweep& sweep_a, const Sweep& sweep_b, double ground_height,
    const CcdOptions& options);

/// Derivative of the distance along the twists.
Vec12 distance_gradient(const ContactGeometry& geometry, const Vec3& center_a, const Vec3& center_b);

/// Energy of a contact: mollifier times potential of the compression below the rest distance.
double contact_energy(const ContactGeometry& geometry, const ContactRange& range, double stiffness);

/// The energy's first and second derivatives.
struct ContactDerivatives {
    Vec12 gradient;  ///< minus the wrench on each object, times step²
    Mat12 hessian;
    Vec12 row;         ///< the distance's gradient: the contact's row in the paper's J
    double force;      ///< along the row [kg·m]
    double stiffness;  ///< along the row, of the (mollified) potential [kg]
};

/// `with_curvature` false leaves the second derivative of distance and mollifier out of the Hessian, which is then
/// stiffness * row rowᵀ. `with_hessian` false leaves the Hessian unset.
ContactDerivatives contact_derivatives(
    const ContactGeometry& geometry, const ContactRange& range, double stiffness, const Vec3& center_a,
    const Vec3& center_b, bool with_hessian, bool with_curvature);

/// The same for a vertex above the ground, where they are short.
struct GroundDerivatives {
    Vec6 row;  ///< of the height, along the twist
    Mat6 hessian;
    double force, stiffness;
};
GroundDerivatives ground_derivatives(
    double height, const Vec3& arm, const ContactRange& range, double stiffness, bool with_curvature);

}  // namespace diffsim
