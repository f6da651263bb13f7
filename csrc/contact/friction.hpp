#pragma once

#include "contact/contact.hpp"
#include "contact/law.hpp"

/// Where Coulomb friction acts on a contact, and along what.
namespace diffsim {

/// What a contact's friction does, as a share of what it may: u with |u| <= 1, force on a is -μ normal_force u.
struct ContactFriction {
    Vec3 share = Vec3::Zero();  ///< u
    bool slips = false;         ///< |u| = 1, along the slip
};

inline constexpr double kRestingSlip = 1e-11;  ///< [m]: what slips by less has no direction, and counts as sticking

struct FrictionFrame {
    Vec3 point;                    ///< where the two surfaces meet, margins included: both objects are pushed here
    std::array<Vec3, 2> tangents;  ///< orthonormal, and to the normal
};

FrictionFrame friction_frame(const ContactGeometry& geometry, const ContactLaw& law);

}  // namespace diffsim
