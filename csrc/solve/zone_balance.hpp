#pragma once

#include "solve/model_direction.hpp"
#include "solve/zone_search.hpp"

/// The solution of a zone with friction.
namespace diffsim {

/// Find where all forces are in balance, friction's among them: by one model after the other to the end, since there is
/// no energy to go down on. See docs/friction.md. The search's result says how that went.
void find_balance(ZoneSearch& search, ModelDirection& model);

}  // namespace diffsim
