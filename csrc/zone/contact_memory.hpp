#pragma once

#include "zone/zone_point.hpp"

/// What changes the laws of a zone's contacts while it is solved, and lasts from list to list; see ContactMemory.
namespace diffsim {

/// Begin anew: no contacts, no memory, none of the bodies that joined with contacts.
void forget_contacts(Zone& zone);

/// Widen the range of contacts whose objects start the step next to their pole, here and in all lists to come; see
/// rescued_range.
void rescue_contacts(Zone& zone);

/// Let every contact's force at a point act at its rest distance, and make contacts this many times stiffer.
/// `zone` is one of exact contacts.
void shift_contacts(Zone& zone, const ZonePoint& point, double stiffening);

/// Contacts that were listed anew have the ranges and push as before.
void recall_contacts(Zone& zone);

}  // namespace diffsim
