#pragma once

#include <vector>

#include "zone/zone_point.hpp"

/// Who the failure of a zone is about: objects (Model::name), ascending.
namespace diffsim {

/// Where a zone was not solved: all that is in it, or of many the few that forces balance least for.
std::vector<int> unbalanced_objects(const Zone& zone, const ZonePoint& point);

/// Where drives were blocked: the driven bodies, `blocked`, and what they squeeze, all that contacts connect with them.
std::vector<int> squeezed_objects(const Zone& zone, const ZonePoint& point, const std::vector<int>& blocked);

}  // namespace diffsim
