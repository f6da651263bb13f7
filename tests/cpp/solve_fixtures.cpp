#include "solve_fixtures.hpp"

namespace fixtures::solve {

Cubes::Cubes(bool on_ground) {
    model.thickness = kThickness;
    if (on_ground) model.ground = {true, 0.0, 0.5 * kThickness};
    make_zone(zone, model, materials, kDefaultCompliance, Vec3::Zero());
}

void Cubes::add(const Vec3& position) {
    const Vec3 half = Vec3::Constant(kHalf);
    const int id = model.body_count();
    model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness));
    zone.bodies.push_back(fixtures::zone_body(id, {Mat3::Identity(), position}, 1.0, fixtures::box_inertia(half, 1.0)));
    zone.bodies.back().target[5] = -kFall;
    ++zone.dynamic_count;
}

ZoneResult Cubes::solve() { return solve_zone(zone, nobody, {}, workspace, swept); }

}  // namespace fixtures::solve
