#pragma once

#include <array>
#include <string_view>
#include <type_traits>
#include <variant>

#include "adjoint/adjoint.hpp"
#include "model/model.hpp"
#include "model/state.hpp"

/// The inputs of a rollout, one line each. All that hands them on loops over this table, here, in the bindings and in
/// the Python layer: who adds a parameter adds a line, and the physics that reads the member it names.
namespace diffsim {

enum class InputKind { state, control, parameter };

/// What an input has one row of, along its first axis.
enum class Axis { none, bodies, nodes, objects, cloths };

/// What a parameter may be. Those with a sign are scales: a matrix is to be positive definite.
enum class Allowed { any, positive, not_negative };

/// The member of the core's structs that holds an input, or a row of it; its type tells the axes behind the first.
using InputPlace = std::variant<
    Vec3 BodyState::*, Vec4 BodyState::*, std::vector<Vec3> SceneState::*,  //
    Vec3 BodyControl::*, std::vector<Vec3> SceneControl::*,                 //
    Vec3 Parameters::*, std::vector<double> Parameters::*, std::vector<Mat3> Parameters::*, double ClothParameters::*>;

struct Input {
    const char* label;  ///< as users know it: "state.position", "mass"
    Axis axis;
    const char* unit;
    InputPlace place;
    bool GradientNeeds::* need;  ///< what its gradient takes; null: nothing that a backward does not do anyway
    Allowed allowed = Allowed::any;
};

/// State, controls, parameters, in the order of the operator's arguments. All are differentiable.
inline constexpr Input kInputs[] = {
    {"state.position", Axis::bodies, "m", &BodyState::position, &GradientNeeds::place},
    {"state.orientation", Axis::bodies, "", &BodyState::orientation, &GradientNeeds::place},
    {"state.velocity", Axis::bodies, "m/s", &BodyState::velocity, &GradientNeeds::place},
    {"state.angular_velocity", Axis::bodies, "rad/s", &BodyState::angular_velocity, &GradientNeeds::place},
    {"state.node_position", Axis::nodes, "m", &SceneState::node_position, &GradientNeeds::place},
    {"state.node_velocity", Axis::nodes, "m/s", &SceneState::node_velocity, &GradientNeeds::place},

    {"control.force", Axis::bodies, "N", &BodyControl::force, nullptr},
    {"control.torque", Axis::bodies, "N·m", &BodyControl::torque, nullptr},
    {"control.node_force", Axis::nodes, "N", &SceneControl::node_force, nullptr},
    {"control.body_velocity", Axis::bodies, "m/s", &BodyControl::velocity, &GradientNeeds::place},
    {"control.body_angular_velocity", Axis::bodies, "rad/s", &BodyControl::angular_velocity, &GradientNeeds::place},
    {"control.node_velocity", Axis::nodes, "m/s", &SceneControl::node_velocity, &GradientNeeds::place},

    {"mass", Axis::bodies, "kg", &Parameters::mass, &GradientNeeds::mass, Allowed::positive},
    {"inertia", Axis::bodies, "kg·m²", &Parameters::inertia, &GradientNeeds::inertia, Allowed::positive},
    {"gravity", Axis::none, "m/s²", &Parameters::gravity, nullptr},
    {"friction", Axis::objects, "", &Parameters::friction, nullptr, Allowed::not_negative},
    {"cloth_density", Axis::cloths, "kg/m²", &ClothParameters::density, &GradientNeeds::mass, Allowed::positive},
    {"cloth_stretch", Axis::cloths, "N/m", &ClothParameters::stretch, &GradientNeeds::material, Allowed::positive},
    {"cloth_shear", Axis::cloths, "N/m", &ClothParameters::shear, &GradientNeeds::material, Allowed::positive},
    {"cloth_bend", Axis::cloths, "N·m", &ClothParameters::bend, &GradientNeeds::material, Allowed::positive},
    {"cloth_damping", Axis::cloths, "s", &ClothParameters::damping, &GradientNeeds::material, Allowed::not_negative},
};
inline constexpr std::size_t kInputCount = std::size(kInputs);

// ---- what the place of an input tells -------------------------------------------------------------------------------

template <typename T, typename Owner>
constexpr InputKind kind_of(T Owner::*) {
    if (std::is_same_v<Owner, BodyState> || std::is_same_v<Owner, SceneState>) return InputKind::state;
    if (std::is_same_v<Owner, BodyControl> || std::is_same_v<Owner, SceneControl>) return InputKind::control;
    return InputKind::parameter;
}

constexpr InputKind kind_of(const Input& input) {
    return std::visit([](auto member) { return kind_of(member); }, input.place);
}

/// The axes of one row.
struct RowShape {
    std::array<int, 2> axes{};
    int rank = 0;
};

template <typename T, typename Owner>
constexpr RowShape row_shape(T Owner::*) {
    if (std::is_same_v<T, Vec3> || std::is_same_v<T, std::vector<Vec3>>) return {{3}, 1};
    if (std::is_same_v<T, Vec4>) return {{4}, 1};
    if (std::is_same_v<T, std::vector<Mat3>>) return {{3, 3}, 2};
    return {};
}

constexpr RowShape row_shape(const Input& input) {
    return std::visit([](auto member) { return row_shape(member); }, input.place);
}

/// How many rows an input has; 1 of what has no such axis.
inline int row_count(const Model& model, Axis axis) {
    switch (axis) {
        case Axis::bodies:
            return model.body_count();
        case Axis::nodes:
            return model.node_count();
        case Axis::objects:
            return model.object_count();
        case Axis::cloths:
            return model.cloth_count();
        case Axis::none:
            break;
    }
    return 1;
}

// ---- the order of the table -----------------------------------------------------------------------------------------

constexpr std::size_t count_of(InputKind kind) {
    std::size_t count = 0;
    for (const Input& input : kInputs)
        if (kind_of(input) == kind) ++count;
    return count;
}
inline constexpr std::size_t kStateCount = count_of(InputKind::state);

constexpr bool inputs_are_in_order() {
    for (std::size_t k = 1; k < kInputCount; ++k)
        if (kind_of(kInputs[k]) < kind_of(kInputs[k - 1])) return false;
    return true;
}
static_assert(inputs_are_in_order(), "the state comes first, then controls, then parameters");

/// Where in the table an input is. Of a name there is not, no constant.
constexpr std::size_t input_index(std::string_view label) {
    for (std::size_t k = 0; k < kInputCount; ++k)
        if (label == kInputs[k].label) return k;
    throw label;
}

template <typename... Cases>
struct OneOf : Cases... {
    using Cases::operator()...;
};
template <typename... Cases>
OneOf(Cases...) -> OneOf<Cases...>;

/// For every input of a kind, call that of the cases, (index in the table, member), that takes its member: there has to
/// be one for every type of member.
template <InputKind kind, typename... Cases>
void for_each_input(const Cases&... cases) {
    const OneOf one_of{cases...};
    for (std::size_t k = 0; k < kInputCount; ++k)
        std::visit(
            [&](auto member) {
                if constexpr (kind_of(decltype(member){}) == kind) one_of(k, member);
            },
            kInputs[k].place);
}

}  // namespace diffsim
