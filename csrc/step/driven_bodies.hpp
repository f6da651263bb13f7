#pragma once

#include "zone/zone.hpp"

namespace diffsim {

/// What stops a driven body on its way.
struct DriveStop {
    double part = 1.0;       ///< of its motion that is free
    int obstacle = kNobody;  ///< index into Model::bodies
};

/// Whether a driven body, one of `passive`, comes to a static one on its way: neither gives way. Bodies that cross when
/// the step starts are left alone. The chord of the motion is looked at, as by all of CCD.
DriveStop find_static_obstacle(const Model& model, const PassiveBodies& passive, const PassiveBody& driven);

}  // namespace diffsim
