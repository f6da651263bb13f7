#pragma once

#include <array>

#include "contact/friction.hpp"
#include "zone/contact_row.hpp"

/// The slip of contacts with friction, as linear rows over the coordinates of a zone.
namespace diffsim {

using Vec2 = Eigen::Vector2d;
using Mat2 = Eigen::Matrix2d;

/// That of a contact from model to model.
struct FrictionState : ContactFriction {
    Vec3 multiplier =
        Vec3::Zero();       ///< u of the model before: from there on springs act that sticking contacts slip against
    bool is_known = false;  ///< there was a model before
};

/// Slip of the material points that meet in a contact from the start of the step to its end, along two tangents: slip +
/// rowsᵀ p. Its bodies and nodes are those of its normal row.
struct FrictionRow {
    std::size_t normal = 0;    ///< its contact's row in the model
    double coefficient = 0.0;  ///< μ
    std::array<Vec3, 2> tangents;
    std::array<Vector<9>, 2> relative;  ///< as ContactRow::relative
    std::vector<double> node_weights;   ///< of the normal row's nodes, signed
    Vec2 slip = Vec2::Zero();           ///< at p = 0 [m]
    Vec2 share = Vec2::Zero(), multiplier = Vec2::Zero();
    bool slips = false, is_known = false;
    double bound = 0.0;  ///< of its force, where bounds stay: see BalanceGoal [kg·m]
    double reach = 0.0;  ///< slip against the multiplier at which a sticking contact's force is at its bound [m]

    void set_state(const FrictionState& state);
    FrictionState state() const;
};

/// Linearised where the objects are placed, for p counted from y_now. What moves as told does so to its target.
FrictionRow make_friction_row(
    const Zone& zone, const ZoneContact& contact, const ContactGeometry& geometry, const Placement& at,
    const Coordinates& y_now);

/// rowsᵀ p of each.
void slips_times(
    const std::vector<FrictionRow>& friction, const std::vector<ContactRow>& rows, const Coordinates& p,
    std::vector<Vec2>& products);

/// sum += rows * force
void add_friction(const FrictionRow& friction, const ContactRow& row, const Vec2& force, Coordinates& sum);

/// Of the slip along a direction in the tangent plane, as one row: what its bodies' `relative` is.
inline Vector<9> relative_along(const FrictionRow& friction, const Vec2& direction) {
    return direction[0] * friction.relative[0] + direction[1] * friction.relative[1];
}

/// system += stiffness * that row with itself, as far as nodes take part.
void add_friction_node_stiffness(
    const FrictionRow& friction, const ContactRow& row, const Vec2& direction, double stiffness, BlockSystem& system);

}  // namespace diffsim
