#include "solve/zone_solver.hpp"

#include "fixtures.hpp"

namespace test_zone_balance {

using namespace diffsim;

namespace {

constexpr double kThickness = 1e-4;
constexpr double kFall = 9.8e-4;  // of a step [m]
constexpr double kFriction = 0.5;
constexpr double kTilt = 2e-5 * kFall;  // the box turns by what compresses its contacts [m]

/// A flat box of 1 kg on the ground, at rest, that something pulls aside.
struct PulledBox {
    Model model;
    std::vector<ClothParameters> materials;
    std::vector<double> friction = {kFriction, kFriction};
    PassiveBodies nobody;
    ZoneWorkspace workspace;
    std::vector<Box> swept;
    Zone zone;

    explicit PulledBox(double pull) {
        const Vec3 half(0.1, 0.1, 0.02);
        model.thickness = kThickness;
        model.ground = {true, 0.0, 0.5 * kThickness};
        model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness));
        make_zone(zone, model, materials, kDefaultCompliance, Vec3::Zero());
        zone.friction = &friction;
        const Pose pose{Mat3::Identity(), Vec3(0.0, 0.0, half.z() + kThickness * (1.0 - 1e-5))};
        zone.bodies.push_back(fixtures::zone_body(0, pose, 1.0, fixtures::box_inertia(half, 1.0)));
        zone.bodies.back().target << 0.0, 0.0, 0.0, pull, 0.0, -kFall;
        zone.dynamic_count = 1;
        const ZoneResult result = solve_zone(zone, nobody, {}, workspace, swept);
        CHECK(result.status == StepStatus::converged);
        CHECK(workspace.point.active.size() == 4);
        CHECK(workspace.friction.size() == 4);
    }
    Vec3 shift() const { return workspace.point.y.bodies[0].tail<3>(); }
};

}  // namespace

TEST(what_is_pulled_by_less_than_its_friction_stays) {
    const PulledBox box(0.4 * kFall);
    CHECK(std::abs(box.shift().x()) <= kTilt);
    for (const ContactFriction& friction : box.workspace.friction) {
        CHECK(!friction.slips);
        CHECK(friction.share.norm() <= 1.0);
    }
}

TEST(what_is_pulled_by_more_goes_by_the_rest) {
    const PulledBox box(0.7 * kFall);
    CHECK_NEAR(box.shift().x(), 0.2 * kFall, kTilt);
    CHECK(std::abs(box.shift().y()) <= 1e-15);
    for (const ContactFriction& friction : box.workspace.friction) {
        CHECK(friction.slips);
        CHECK_NEAR(friction.share, Vec3(1.0, 0.0, 0.0), 1e-6);
    }
}

}  // namespace test_zone_balance
