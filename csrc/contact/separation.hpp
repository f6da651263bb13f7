#pragma once

#include "contact/impact_qp.hpp"

namespace diffsim {

struct Separation {
    std::vector<Pose> poses;  ///< of the zone's dynamic bodies, moved
    std::vector<Vec3> nodes;  ///< of its cloths, moved
    bool complete = false;    ///< every pair is at its rest distance or further
};

/// Move dynamic bodies and cloth that touch, or are nearer than their rest distance, apart to it, by a smallest motion in the
/// mass metric. Overlaps of rounding size are resolved; anything deeper is a mistake that the scene's validation finds.
/// The zone's bodies are its dynamic bodies at their poses, its nodes those of all cloths. Pinned nodes stay.
Separation separate(Zone zone, const PassiveBodies& passive);

}  // namespace diffsim
