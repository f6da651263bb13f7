#pragma once

#include "zone/zone_contacts.hpp"

/// Moving apart what a state has too near to each other.
namespace diffsim {

struct Separation {
    std::vector<Pose> poses;  ///< of the zone's dynamic bodies, moved
    std::vector<Vec3> nodes;  ///< of its cloths, moved
    bool complete = false;    ///< every pair is at its rest distance or further
    Contact worst;            ///< otherwise the pair that lacks most of its contact's depth
    double distance = 0.0;    ///< of its features, margins not taken off [m]
    double rest = 0.0;        ///< what that should be [m]
    double lack = 0.0;        ///< how much of the depth is missing [1]
};

/// Move dynamic bodies and cloth that touch, or are nearer than their rest distance, apart to it, by a smallest motion
/// in the mass metric. Overlaps of rounding size are resolved; anything deeper is a mistake that the scene's validation
/// finds. The zone's bodies are its dynamic bodies at their poses, its nodes those of all cloths. Pinned nodes stay.
Separation separate(Zone zone, const PassiveBodies& passive);

}  // namespace diffsim
