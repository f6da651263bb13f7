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
    double height = 0.0;           ///< [m]
    std::optional<double> margin;  ///< none: half the thickness of what meets it [m]
};

/// Stands for the ground where an object index is expected.
inline constexpr int kGround = -1;
/// No object at all.
inline constexpr int kNobody = -2;

struct Model {
    std::vector<Body> bodies;
    std::vector<Cloth> cloths;
    Ground ground;
    double thickness = 0.0;  ///< distance kept between surfaces of default margin; of several, the smallest [m]
    std::vector<double> object_thickness;  ///< the same of each object; empty: all have `thickness` [m]

    int body_count() const { return static_cast<int>(bodies.size()); }
    int cloth_count() const { return static_cast<int>(cloths.size()); }
    /// Bodies, cloths and the ground.
    int object_count() const { return body_count() + cloth_count() + (ground.present ? 1 : 0); }
    int node_count() const { return cloths.empty() ? 0 : cloths.back().first_node + cloths.back().node_count(); }

    // Objects are the bodies, then the cloths, or kGround.
    bool is_cloth(int object) const { return object >= body_count(); }
    const Cloth& cloth_of(int object) const { return cloths[object - body_count()]; }
    /// Whether forces move it: a dynamic body or a cloth.
    bool yields(int object) const { return object >= 0 && (is_cloth(object) || bodies[object].is_dynamic()); }
    double margin(int object) const { return is_cloth(object) ? cloth_of(object).margin : bodies[object].margin; }
    double own_thickness(int object) const {
        return object_thickness.empty() ? thickness : object_thickness[static_cast<std::size_t>(object)];
    }
    /// Distance of the ground's collision surface from its height, for an object that meets it [m].
    double ground_margin(int object) const { return ground.margin.value_or(0.5 * own_thickness(object)); }
    // Of a pair; `b` may be the ground, which has no size and so takes the other's thickness.
    double margin_sum(int a, int b) const { return margin(a) + (b == kGround ? ground_margin(a) : margin(b)); }
    double pair_thickness(int a, int b) const {
        return b == kGround ? own_thickness(a) : 0.5 * (own_thickness(a) + own_thickness(b));
    }
    const std::string& name(int object) const;
};

/// How the backward of a step treats the contact terms; see contact/adjoint.hpp.
enum class AdjointMode { exact, qr, dense };

/// The time scheme, see step/step.hpp.
enum class Integrator { implicit_euler, second_order };

/// What a solve is for: with implicit Euler the whole step; else the first stage of cloth, the new velocities or the
/// new places.
enum class StepPart { whole, first_stage, velocities, places };

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
    /// Newton iterates that make up the elastic pass of split coupling, 1 for Eq. 3 of
    /// [qiao2020scalable]; none: it converges.
    std::optional<int> newton_iterations;
    Integrator integrator = Integrator::implicit_euler;
    // Set by the step itself:
    StepPart part = StepPart::whole;
    bool is_substep = false;  ///< of a step that was not found at once: what is not found soon is halved again
};

/// Physical parameters of one scene. Entries of static and kinematic bodies are not used.
struct Parameters {
    std::vector<double> mass;     ///< [kg]
    std::vector<Mat3> inertia;    ///< body frame, symmetric [kg·m²]
    Vec3 gravity = Vec3::Zero();  ///< [m/s²]
    std::vector<ClothParameters> cloths;
    std::vector<double> friction;  ///< μ of each object: bodies, cloths, then the ground; empty where there is none [1]
};

}  // namespace diffsim
