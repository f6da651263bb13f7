#pragma once

#include "contact/zone_contacts.hpp"

namespace diffsim {

struct ImpactDirection {
    Coordinates y_end;  ///< where it leads to
    double step;        ///< how much of the way CCD allows
    int newton_steps = 0;
};

/// A direction past the impacts that stop a plain Newton step: pairs hit on the way to the target are linearised at
/// their time of impact, the QP with these rows gives a new end point, and pairs hit on the way to that one are added
/// until none is. Rows are straight and bodies turn: where a body would turn further than `max_turn` [rad], its mass is
/// scaled up, which shortens its part of the direction until the rows mean something. `before`: what was found from here with fewer contacts listed,
/// or null.
ImpactDirection impact_direction(
    const Zone& zone, const ZonePoint& point, double max_turn, BlockSystem& system,
    const ImpactDirection* before = nullptr);

}  // namespace diffsim
