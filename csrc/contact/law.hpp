#pragma once

#include "contact/potential.hpp"

/// What a contact pushes with, as a function of its distance.
namespace diffsim {

/// The distances at which things happen between two surfaces with this sum of margins.
struct ContactRange {
    double rest;     ///< contact pushes below this [m]
    double landing;  ///< where last step's motion is stopped: inside the contact's reach, far from its pole [m]
    double floor;    ///< motions are stopped here [m]
    double pole;     ///< the energy is infinite here [m]
    double limit;    ///< objects this near penetrate [m]
};
ContactRange contact_range(double margin_sum, double thickness);

/// The range of a contact that starts its step at this distance. A step that did not converge may leave objects next to
/// their pole; theirs moves half way towards the limit, so that the next step can push them out.
ContactRange rescued_range(const ContactRange& range, double start_distance);

/// Stiffness k of a contact between bodies of these masses; a body that does not yield has infinite mass. It
/// depends on masses alone, so that it need not be differentiated with respect to the geometry:
/// k = reduced mass / compliance, times mass ratio / 100 where that is above 1: a light body under a heavy one
/// carries many times its own weight.
struct ContactStiffness {
    double value;
    double log_gradient_a, log_gradient_b;  ///< d(log k)/d(mass) [1/kg]
};
ContactStiffness contact_stiffness(double mass_a, double mass_b, double compliance);

struct ContactLaw {
    ContactRange range;
    ContactStiffness stiffness;
    double shift = 0.0;         ///< of range.rest, so that an exact contact's force acts at its rest distance [m]
    double friction = 0.0;      ///< Coulomb's coefficient μ [1]
    double margin_share = 0.5;  ///< of a's margin in the sum of both: where between them the surfaces meet [1]
};

/// Energy of a contact at this distance, and its derivatives with respect to the compression below the rest distance.
inline PotentialValue normal_force(const ContactLaw& law, double distance) {
    return contact_potential(law.range.rest - distance, law.range.rest - law.range.pole, law.stiffness.value);
}

/// Shift the rest distance, the pole staying where it is, so that this force acts where the rest distance was.
void shift_rest(ContactLaw& law, double force);

}  // namespace diffsim
