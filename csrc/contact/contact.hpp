#pragma once

#include <Eigen/Geometry>
#include <tuple>

#include "collision/candidates.hpp"
#include "contact/law.hpp"
#include "geometry/distance.hpp"
#include "model/model.hpp"

/// One contact: a pair of features of two objects and its distance. Its derivatives are in contact_derivatives.hpp.
namespace diffsim {

struct CcdOptions;

enum class FeatureKind : std::uint8_t { vertex, edge, patch };

/// A feature of a mesh.
struct Feature {
    FeatureKind kind;
    int index;
};

/// Which features of which objects. Objects are numbered as in Model::object_count, or kGround for object_b.
struct Contact {
    int object_a, object_b;
    ContactType type;          ///< vertex_patch with the ground
    int feature_a, feature_b;  ///< feature_b is -1 with the ground

    bool with_ground() const { return object_b == kGround; }
    Feature on_a() const {
        const FeatureKind other = type == ContactType::vertex_patch ? FeatureKind::vertex : FeatureKind::patch;
        return {type == ContactType::edge_edge ? FeatureKind::edge : other, feature_a};
    }
    Feature on_b() const {
        const FeatureKind other = type == ContactType::vertex_patch ? FeatureKind::patch : FeatureKind::vertex;
        return {type == ContactType::edge_edge ? FeatureKind::edge : other, feature_b};
    }
};

/// An order for lists of contacts that are looked up.
inline bool comes_before(const Contact& c, const Contact& d) {
    return std::tie(c.object_a, c.object_b, c.type, c.feature_a, c.feature_b) <
           std::tie(d.object_a, d.object_b, d.type, d.feature_a, d.feature_b);
}

/// What the multiplier of an exact contact follows from: it acts as one with this compliance
/// and its rest distance shifted.
struct ExactContact {
    double shift;  ///< [m]
    double compliance;
};

/// Where the surface of an object is: at a pose, or, for cloth, at its nodes. Of a body with both, `nodes` are the
/// vertices that are needed, placed.
struct Surface {
    const CollisionMesh* mesh = nullptr;
    const Pose* pose = nullptr;
    const Vec3* nodes = nullptr;

    Vec3 vertex(int v) const { return nodes != nullptr ? nodes[v] : *pose * mesh->vertices[v]; }
};

/// Distance and all that its derivatives need.
struct ContactGeometry {
    /// `ground_height` is the ground's in the frame of the surfaces; b is not used with the ground.
    ContactGeometry(const Contact& contact, const Surface& a, const Surface& b, double ground_height);

    ClosestPoints closest;  ///< in world axes
    double distance;        ///< between the bare meshes, margins not taken off [m]
    Vec3 normal;            ///< unit, from b to a
    double sine_sq = 1.0;   ///< of the angle between two edges, 0 if they are parallel to rounding; 1 for other pairs
};

/// The geometry of a contact of two rigid bodies at these poses.
ContactGeometry contact_geometry(
    const Model& model, const Contact& contact, const Pose& pose_a, const Pose& pose_b, double ground_height);

/// A surface at both ends of a motion.
struct SweptSurface {
    Surface begin, end;
};

/// Time of impact in [0, 1] of a contact whose objects' vertices move on straight lines, or kNoImpact. Keeps the
/// distance above `options.min_distance`.
double contact_toi(
    const Contact& contact, const SweptSurface& a, const SweptSurface& b, double ground_height,
    const CcdOptions& options);

/// The vertices of a feature, up to three of a cloth's; -1 fills the rest.
std::array<int, 3> feature_vertices(const CollisionMesh& mesh, const Feature& feature);

}  // namespace diffsim
