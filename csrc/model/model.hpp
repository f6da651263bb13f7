#pragma once

#include <optional>
#include <string>
#include <vector>

#include "geometry/collision_mesh.hpp"
#include "model/cloth.hpp"

/// What a scene is made of. Constant over time, shared by every step, thread and batch element.
namespace diffsim {

enum class BodyKind : int { dynamic = 0, static_ = 1, kinematic = 2 };

struct Body {
    std::string name;
    BodyKind kind = BodyKind::dynamic;
    double margin = 0.0;  ///< the collision surface is the mesh offset by this [m]
    CollisionMesh mesh;   ///< body frame: origin at the centre of mass

    bool is_dynamic() const { return kind == BodyKind::dynamic; }
};

/// The half-space z >= height.
struct Ground {
    bool present = false;
    double height = 0.0;  ///< [m]
    double margin = 0.0;  ///< [m]
};

/// Stands for the ground where an object index is expected.
inline constexpr int kGround = -1;
/// No object at all.
inline constexpr int kNobody = -2;

struct Model {
    std::vector<Body> bodies;
    std::vector<Cloth> cloths;
    Ground ground;
    double thickness = 0.0;  ///< distance kept between surfaces of default margin [m]

    int body_count() const { return static_cast<int>(bodies.size()); }
    int cloth_count() const { return static_cast<int>(cloths.size()); }
    int node_count() const { return cloths.empty() ? 0 : cloths.back().first_node + cloths.back().node_count(); }

    // Objects are the bodies, then the cloths, or kGround.
    bool is_cloth(int object) const { return object >= body_count(); }
    const Cloth& cloth_of(int object) const { return cloths[object - body_count()]; }
    double margin(int object) const {
        return object == kGround ? ground.margin : is_cloth(object) ? cloth_of(object).margin : bodies[object].margin;
    }
    const std::string& name(int object) const;
};

/// How the backward of a step treats the contact terms; see contact/adjoint.hpp.
enum class AdjointMode { exact, qr, dense };

/// Contacts give way to a resting body's weight by about this part of what gravity moves it in a step.
inline constexpr double kDefaultCompliance = 1e-4;

struct Options {
    double dt = 0.01;                          ///< [s]
    double compliance = kDefaultCompliance;    ///< inverse contact stiffness in units of (reduced mass / step²) [1]
    AdjointMode adjoint = AdjointMode::exact;  ///<
    double tolerance = 1e-10;                  ///< on the force balance, relative to the largest contact force [1]
    int max_iterations = 200;                  ///< Newton steps per zone and step
    bool split = false;        ///< cloth moves without contact first, then contacts act on its nodes (split coupling)
    bool global_zone = false;  ///< all that yields is one zone, whether it meets or not
    /// Newton iterates that make up the elastic pass of split coupling, 1 for Eq. 3 of [qiao2020scalable]; none: it converges.
    std::optional<int> newton_iterations;
};

/// Physical parameters of one scene. Entries of static and kinematic bodies are not used.
struct Parameters {
    std::vector<double> mass;     ///< [kg]
    std::vector<Mat3> inertia;    ///< body frame, symmetric [kg·m²]
    Vec3 gravity = Vec3::Zero();  ///< [m/s²]
    std::vector<ClothParameters> cloths;
};

}  // namespace diffsim
