#include "contact/impact_direction.hpp"

#include <algorithm>

#include "fixtures.hpp"
#include "math/rotation.hpp"

using namespace diffsim;

namespace {

constexpr double kHalf = 0.05;       // edge of the boxes, half [m]
constexpr double kThickness = 1e-4;  // [m]

/// Two tilted boxes, a corner of one near a face of the other, about to turn and move into each other.
struct Pair {
    Model model;
    std::vector<ClothParameters> materials;
    PassiveBodies nobody;
    Zone zone;
    ZonePoint point;
    BlockSystem system;
    Coordinates targets;

    explicit Pair(check::Random& random) {
        model.thickness = kThickness;
        const Vec3 half = Vec3::Constant(kHalf);
        for (int i = 0; i < 2; ++i) model.bodies.push_back(fixtures::body(fixtures::box(half), 0.5 * kThickness));
        start_zone(zone, model, materials, kDefaultCompliance, 0.01, Vec3::Zero());
        const Mat3 tilt = exp_rotation(3.0 * fixtures::random_direction(random));
        const double reach = (tilt * half.cwiseProduct(tilt.row(2).transpose().cwiseSign())).z();
        const double gap = kThickness * random.uniform(0.5, 5.0);
        for (int i = 0; i < 2; ++i) {
            const Pose pose{i == 0 ? Mat3(Mat3::Identity()) : tilt, Vec3(0.01, 0.02, i * (kHalf + reach + gap))};
            zone.bodies.push_back(fixtures::zone_body(i, pose, 1.0, fixtures::box_inertia(half, 1.0)));
            zone.bodies.back().target << 0.3 * fixtures::random_vec3(random), 0.01 * fixtures::random_vec3(random);
            targets.bodies.push_back(zone.bodies.back().target);
        }
        zone.dynamic_count = 2;
        Coordinates begin;
        begin.assign_zero(2, 0);
        ContactCoverage coverage;
        collect_contacts(zone, nobody, begin, targets, coverage);
        point.y.assign_zero(2, 0);
        evaluate(zone, point);
        system.set_pattern(base_pattern(zone));
    }
};

}  // namespace

TEST(directions_past_impacts_lead_further_and_are_found_soon) {
    check::Random random(1);
    int stopped = 0, further = 0, most_steps = 0;
    for (int k = 0; k < 300; ++k) {
        NOTE(k);
        Pair pair(random);
        const double plain = allowed_step(pair.zone, pair.point, pair.targets, nullptr);
        if (plain == 1.0) continue;
        ++stopped;
        const ImpactDirection direction = impact_direction(pair.zone, pair.point, 0.5, pair.system);
        CHECK(allowed_step(pair.zone, pair.point, direction.y_end, nullptr) == direction.step);
        further += direction.step > plain ? 1 : 0;
        most_steps = std::max(most_steps, direction.newton_steps);
    }
    CHECK(stopped >= 20);
    CHECK(further >= stopped / 3);
    CHECK(most_steps <= 100);
}
