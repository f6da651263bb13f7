#pragma once

#include <string>
#include <vector>

#include "geometry/collision_mesh.hpp"

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
    Ground ground;
    double thickness = 0.0;  ///< distance kept between surfaces of default margin [m]

    int body_count() const { return static_cast<int>(bodies.size()); }
    double margin(int object) const { return object == kGround ? ground.margin : bodies[object].margin; }
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
};

/// Physical parameters of one cloth.
struct ClothParameters {
    double density = 0.0;  ///< [kg/m²]
    double stretch = 0.0;  ///< uniaxial stress resultant per strain [N/m]
    double shear = 0.0;    ///< [N/m]
    double bend = 0.0;     ///< bending moment per curvature and width [N·m]
    double damping = 0.0;  ///< [s]
};

/// Physical parameters of one scene. Entries of static and kinematic bodies are not used.
struct Parameters {
    std::vector<double> mass;     ///< [kg]
    std::vector<Mat3> inertia;    ///< body frame, symmetric [kg·m²]
    Vec3 gravity = Vec3::Zero();  ///< [m/s²]
    std::vector<ClothParameters> cloths;
};

}  // namespace diffsim
