#include "solve/impact_gate.hpp"

#include "fixtures.hpp"

namespace test_impact_gate {

using namespace diffsim;

namespace {

constexpr double kHalf = 0.05;       // edge of the boxes, half [m]
constexpr double kThickness = 1e-4;  // [m]

/// Two boxes 0.3 m apart, about to move against each other, the second turning by so much.
struct Pair {
    Model model;
    std::vector<ClothParameters> materials;
    Zone zone;
    ZonePoint point;
    Coordinates targets;

    explicit Pair(const Vec3& approach, const Vec3& turn) {
        model.thickness = kThickness;
        const Vec3 half = Vec3::Constant(kHalf);
        for (int i = 0; i < 2; ++i) model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness));
        make_zone(zone, model, materials, kDefaultCompliance, Vec3::Zero());
        for (int i = 0; i < 2; ++i) {
            const Pose pose{Mat3::Identity(), Vec3(0.0, 0.0, 0.3 * i)};
            zone.bodies.push_back(fixtures::zone_body(i, pose, 1.0, fixtures::box_inertia(half, 1.0)));
            if (i == 1) zone.bodies[1].target << turn, approach;
            targets.bodies.push_back(zone.bodies.back().target);
        }
        zone.dynamic_count = 2;
        Coordinates begin;
        begin.assign_zero(2, 0);
        ContactCoverage coverage;
        collect_contacts(zone, PassiveBodies(), begin, targets, coverage);
        point.y.assign_zero(2, 0);
        evaluate(zone, point);
    }

    std::vector<ImpactGate> gates() const { return find_impact_gates(zone, point, targets); }
    Coordinates at(double s) const {
        Coordinates y = targets;
        for (Vec6& body : y.bodies) body *= s;
        return y;
    }
};

}  // namespace

TEST(bodies_may_meet_and_slide_but_not_pass) {
    const Pair pair(Vec3(0.01, 0.02, -0.6), Vec3::Zero());
    const std::vector<ImpactGate> gates = pair.gates();
    CHECK(gates.size() == 1);
    CHECK(gates[0].fast);
    const double meeting = 0.2 / 0.6;  // they are 0.2 m apart
    for (const double s : {0.0, 0.5 * meeting, meeting}) CHECK(gates_hold(gates, pair.zone, pair.at(s)));
    CHECK(!gates_hold(gates, pair.zone, pair.at(1.0)));
    Coordinates aside = pair.at(meeting);
    aside.bodies[1].tail<3>() += Vec3(0.3, -0.2, 0.0);
    CHECK(gates_hold(gates, pair.zone, aside));
    CHECK(may_pass(pair.zone, pair.targets));
}

TEST(slow_bodies_have_no_gates) {
    const Pair pair(Vec3(0.0, 0.0, -0.02), Vec3::Zero());
    CHECK(pair.gates().empty());
    CHECK(!may_pass(pair.zone, pair.targets));
}

TEST(gates_hold_at_the_start_however_bodies_spin) {
    check::Random random(1);
    int found = 0, beyond = 0;
    for (int k = 0; k < 300; ++k) {
        NOTE(k);
        const Pair pair(
            Vec3(0.02, 0.01, -0.35) + 0.1 * fixtures::random_vec3(random), 3.0 * fixtures::random_direction(random));
        for (const ImpactGate& gate : pair.gates()) {
            ++found;
            CHECK(gates_hold({gate}, pair.zone, pair.at(0.0)));
            // Where the points that meet are each other's far sides at the start.
            beyond += gate.least_points < kThickness - 0.6 * std::sqrt(3.0) * kHalf ? 1 : 0;
        }
    }
    CHECK(found >= 100);
    CHECK(beyond >= 5);
}

}  // namespace test_impact_gate
