#pragma once

#include "cloth_fixtures.hpp"
#include "collision/candidates.hpp"

/// Meshes in motion for tests of collision.
namespace fixtures {

/// A deforming mesh in motion, with all that its SweptMesh points to.
struct DeformingSweep {
    const CollisionMesh* mesh;
    std::vector<Vec3> begin, end;
    double reach;
    BoxTree tree = {};

    SweptMesh swept() {
        SweptMesh result{mesh, {}, reach, begin.data(), end.data()};
        tree = refitted_tree(result);
        result.tree = &tree;
        return result;
    }
};

/// A sheet rolled up, shaken, somewhere near the origin.
inline DeformingSweep random_sheet(const Cloth& cloth, check::Random& random, double motion, double reach) {
    const std::vector<Vec3> roll = rolled(cloth.rest, 0.3, 0.15);
    DeformingSweep result{&cloth.surface, {}, {}, reach};
    result.begin =
        moved(shaken(roll, random, 0.05), random_rotation(random), random_vec3(random, 0.4) - Vec3(0, 0.3, 0));
    result.end = shaken(result.begin, random, motion);
    return result;
}

/// An edge along x.
inline CollisionMesh segment() { return build_collision_mesh({Vec3(-1, 0, 0), Vec3(1, 0, 0)}, {}); }

}  // namespace fixtures
