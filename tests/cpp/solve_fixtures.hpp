// Cubes at rest on the ground, for the tests of how a zone is solved.
#pragma once

#include "fixtures.hpp"
#include "solve/zone_solver.hpp"

namespace fixtures::solve {

inline constexpr double kHalf = 0.05;                                   // edge of the cubes, half [m]
inline constexpr double kThickness = 1e-4;                              // [m]
inline constexpr double kFall = 9.8e-4;                                 // of a step [m]
inline constexpr double kTouching = kHalf + kThickness * (1.0 - 1e-5);  // height of a cube's centre on the ground [m]

/// A zone of cubes of 1 kg, that fall where nothing holds them.
struct Cubes {
    Model model;
    std::vector<ClothParameters> materials;
    PassiveBodies nobody;
    ZoneWorkspace workspace;
    std::vector<Box> swept;
    Zone zone;

    explicit Cubes(bool on_ground);
    void add(const Vec3& position);
    ZoneResult solve();
};

}  // namespace fixtures::solve
