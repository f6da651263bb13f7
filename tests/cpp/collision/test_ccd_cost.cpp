// What continuous collision detection costs where motion is large against the distance that is left, and that it is as
// safe and as close there as anywhere: against a reference that is slow and plain.
#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>

#include "ccd_fixtures.hpp"

namespace test_ccd_cost {

using namespace diffsim;
using fixtures::Motion;
using fixtures::random_direction;
using fixtures::random_rotation;
using fixtures::random_vec3;

namespace {

constexpr int kMostIterations = 40;  // whatever the motion and the tolerance
constexpr double kRounding = 1e-13;  // of the largest coordinate

double log_uniform(check::Random& random, double lower, double upper) {
    return std::exp(random.uniform(std::log(lower), std::log(upper)));
}

/// Two features of size 1 that are this far apart, in planes of constant z.
Motion at_gap(check::Random& random, double gap) {
    Motion motion;
    motion.is_edges = random.uniform(0.0, 1.0) < 0.5;
    if (motion.is_edges) {
        for (const double height : {gap, 0.0}) {
            const double angle = random.uniform(0.0, 6.0), part = random.uniform(0.0, 1.0);
            const Vec3 edge(std::cos(angle), std::sin(angle), 0.0), at(0.0, 0.0, height);
            motion.begin.push_back(at - part * edge);
            motion.begin.push_back(at + (1.0 - part) * edge);
        }
    } else {
        motion.begin.emplace_back(0.0, 0.0, gap);
        for (int k = 0; k < 3; ++k) {
            const double angle = 2.0 * EIGEN_PI / 3.0 * (k + random.uniform(0.0, 0.5));
            motion.begin.emplace_back(std::cos(angle), std::sin(angle), 0.0);
        }
    }
    motion.end = motion.begin;
    return motion;
}

std::size_t first_of_b(const Motion& motion) { return motion.is_edges ? 2 : 1; }

/// How the features move; all start at a small gap unless said otherwise.
enum class Family { sliding, grazing, past_a_corner, turning_together, spinning, stretching, deforming, near_parallel };
constexpr Family kFamilies[] = {Family::sliding,  Family::grazing,    Family::past_a_corner, Family::turning_together,
                                Family::spinning, Family::stretching, Family::deforming,     Family::near_parallel};

Motion make_motion(check::Random& random, Family family, double gap) {
    Motion motion = at_gap(random, gap);
    std::vector<Vec3>&begin = motion.begin, &end = motion.end;
    const std::size_t split = first_of_b(motion), count = begin.size();
    const auto map = [&](std::size_t first, std::size_t last, const Mat3& A, const Vec3& shift) {
        for (std::size_t k = first; k < last; ++k) end[k] = A * begin[k] + shift;
    };
    const Mat3 identity = Mat3::Identity();
    switch (family) {
        case Family::sliding: {
            Vec3 along = log_uniform(random, 0.1, 1e3) * random_direction(random);
            along.z() = 0.0;
            map(0, split, identity, along);
            break;
        }
        case Family::grazing:  // nearest in the middle of the way
            for (std::size_t k = 0; k < count; ++k) {
                Vec3 velocity = random_vec3(random, 0.3);
                if (k < split) velocity += Vec3(100.0, 50.0, 0.0);
                end[k] = begin[k] + 0.5 * velocity;
                begin[k] -= 0.5 * velocity;
            }
            break;
        case Family::past_a_corner: {
            const double far = log_uniform(random, 1.0, 1e4);
            motion.is_edges = false;
            const double aside = random.uniform(0.5, 1.0) < 0.75 ? 0.5 * gap : gap;
            begin = {Vec3(1.0 + aside, 0.0, far), Vec3(-1, -1, 0), Vec3(1, 0, 0), Vec3(-1, 1, 0)};
            end = begin;
            end[0].z() = -far;
            break;
        }
        case Family::turning_together:
            map(0, count, random_rotation(random), random_vec3(random));
            break;
        case Family::spinning:
            map(0, split, random_rotation(random), random_vec3(random, 0.1));
            map(split, count, random_rotation(random), random_vec3(random, 0.1));
            break;
        case Family::stretching:
            map(0, count, identity + 0.9 * random.matrix(3, 3), Vec3::Zero());
            break;
        case Family::deforming: {
            const double size = log_uniform(random, 1e-2, 1e2);
            for (Vec3& x : end) x += random_vec3(random, size);
            break;
        }
        case Family::near_parallel: {
            motion.is_edges = true;
            const double skew = log_uniform(random, 1e-10, 1e-2);
            begin = {Vec3(-0.5, 0, gap), Vec3(0.5, 0, gap), Vec3(-0.8, 0, 0), Vec3(0.3, 0, 0)};
            for (Vec3& x : begin) x += random_vec3(random, skew);
            end = begin;
            for (Vec3& x : end) x += random_vec3(random, skew);
            map(0, 4, random_rotation(random), Vec3::Zero());
            break;
        }
    }
    return motion;
}

/// Scaled about the origin, and moved away from it.
void place(Motion& motion, double scale, const Vec3& shift) {
    for (std::vector<Vec3>* points : {&motion.begin, &motion.end})
        for (Vec3& x : *points) x = scale * x + shift;
}

double largest_coordinate(const Motion& motion) {
    double largest = 0.0;
    for (const std::vector<Vec3>* points : {&motion.begin, &motion.end})
        for (const Vec3& x : *points) largest = std::max(largest, x.cwiseAbs().maxCoeff());
    return largest;
}

/// Whether the distance stays above the least in [begin, end]: it cannot fall faster than any two vertices close in.
bool stays_above(const Motion& motion, double least, double speed, double begin, double end) {
    const double middle = 0.5 * (begin + end), distance = motion.distance(middle);
    if (!(distance > least)) return false;
    if (distance - 0.5 * speed * (end - begin) > least) return true;
    return stays_above(motion, least, speed, begin, middle) && stays_above(motion, least, speed, middle, end);
}

double largest_speed(const Motion& motion) {
    double speed = 0.0;
    const std::size_t split = first_of_b(motion);
    for (std::size_t i = 0; i < split; ++i)
        for (std::size_t j = split; j < motion.begin.size(); ++j)
            speed = std::max(speed, ((motion.end[i] - motion.begin[i]) - (motion.end[j] - motion.begin[j])).norm());
    return speed;
}

}  // namespace

TEST(every_motion_takes_a_bounded_number_of_advances) {
    check::Random random(21);
    for (const Family family : kFamilies) {
        NOTE(static_cast<int>(family));
        int impacts = 0;
        for (int k = 0; k < 400; ++k) {
            NOTE(k);
            CcdOptions options;
            // The normal of edges at an angle of 1e-10 is half lost in rounding, and so is a distance of 1e-8.
            options.tolerance = log_uniform(random, family == Family::near_parallel ? 1e-7 : 1e-9, 1e-3);
            options.min_distance = k % 4 == 0 ? 0.0 : log_uniform(random, 1e-6, 1.0);
            const double gap = options.min_distance + options.tolerance * log_uniform(random, 1.01, 1e4);
            Motion motion = make_motion(random, family, gap);
            const double scale = k % 3 == 1 ? 1e-6 : 1.0;
            place(motion, scale, k % 3 == 2 ? random_vec3(random, 100.0) : Vec3::Zero());
            options.min_distance *= scale;
            options.tolerance *= scale;
            const double rounding = kRounding * largest_coordinate(motion);
            const double tolerance = std::max(options.tolerance, rounding);
            if (motion.distance(0.0) <= options.min_distance + tolerance) continue;

            const CcdResult result = motion.ccd(options);
            CHECK(result.iterations <= kMostIterations);
            const double until = std::min(result.toi, 1.0);
            for (int s = 0; s <= 50; ++s) CHECK(motion.distance(until * s / 50) >= options.min_distance - rounding);
            if (result.toi == kNoImpact) continue;
            ++impacts;
            CHECK(motion.distance(result.toi) <= options.min_distance + 1.001 * tolerance);
        }
        if (family != Family::sliding) CHECK(impacts >= 20);
    }
}

TEST(motions_are_clear_all_the_way_to_the_impact) {
    check::Random random(22);
    for (const Family family : kFamilies) {
        NOTE(static_cast<int>(family));
        for (int k = 0; k < 40; ++k) {
            NOTE(k);
            CcdOptions options;
            options.tolerance = 1e-4;
            options.min_distance = k % 4 == 0 ? 0.0 : log_uniform(random, 1e-4, 1e-1);
            const double gap = options.min_distance + options.tolerance * log_uniform(random, 1.01, 1e3);
            const Motion motion = make_motion(random, family, gap);
            if (motion.distance(0.0) <= options.min_distance + options.tolerance) continue;
            const CcdResult result = motion.ccd(options);
            // It aims half a tolerance higher, so that a reference of finite depth can tell.
            const double least = options.min_distance + 0.4 * options.tolerance;
            CHECK(stays_above(motion, least, largest_speed(motion), 0.0, std::min(result.toi, 1.0)));
        }
    }
}

TEST(advances_that_run_out_end_early_and_never_in_a_miss) {
    check::Random random(23);
    int cut_short = 0;
    for (const Family family : kFamilies) {
        for (int k = 0; k < 100; ++k) {
            CcdOptions options;
            options.min_distance = 1e-3;
            options.tolerance = 1e-5;
            const Motion motion = make_motion(random, family, 1.2e-3);
            const double toi = motion.toi(options);
            for (int most = 0; most < 6; ++most) {
                options.max_iterations = most;
                const double early = motion.toi(options);
                CHECK((early == toi || (early < 1.0 && early <= toi)));
                cut_short += early < std::min(toi, 1.0);
            }
        }
    }
    CHECK(cut_short >= 500);
}

// A wire of .1 mm lies under a sheet whose triangles are .1 m wide: how far the sheet swings and slides in a step is
// huge against the hundredth of the wire's thickness that is kept.
TEST(a_thin_wire_under_a_sheet_takes_few_advances) {
    CcdOptions options;
    options.min_distance = 1e-5;
    options.tolerance = 1e-7;
    check::Random random(24);
    for (int k = 0; k < 200; ++k) {
        NOTE(k);
        const double gap = options.min_distance * random.uniform(1.05, 3.0);
        Motion motion{
            {Vec3(-0.05, 0.01, gap), Vec3(0.05, 0.02, gap), Vec3(0.01, -0.5, 0), Vec3(0.01, 0.5, 0)}, {}, true};
        // The edge swings about the wire as it slides along, which keeps the gap but for second order in the turn.
        const Mat3 turn = exp_rotation(Vec3(0.0, random.uniform(-0.3, 0.3), random.uniform(-0.3, 0.3)));
        const Vec3 contact(0.01, 0.0, gap), slide(0.0, random.uniform(-0.1, 0.1), 0.0);
        for (int i = 0; i < 2; ++i) motion.end.push_back(contact + turn * (motion.begin[i] - contact) + slide);
        motion.end.push_back(motion.begin[2]);
        motion.end.push_back(motion.begin[3]);
        const CcdResult result = motion.ccd(options);
        CHECK(result.iterations <= 25);
        if (result.toi != kNoImpact)
            CHECK(motion.distance(result.toi) <= options.min_distance + 1.001 * options.tolerance);
        CHECK(stays_above(motion, options.min_distance, largest_speed(motion), 0.0, std::min(result.toi, 1.0)));
    }
}

// Bodies of 1e-6 m fall a thousand times their size in a step of .01 s, tumbling past each other.
TEST(bodies_of_a_micrometre_take_few_advances) {
    check::Random random(25);
    int impacts = 0;
    for (int k = 0; k < 500; ++k) {
        NOTE(k);
        CcdOptions options;
        options.min_distance = 1e-10;
        options.tolerance = 1e-12;
        Motion motion = at_gap(random, 1.05e-4);
        const std::size_t split = first_of_b(motion);
        const Vec3 fall(0.0, 0.0, -1e-3), drift = random_vec3(random, k % 2 == 0 ? 1e-6 : 1e-3);
        place(motion, 1e-6, random_vec3(random));
        const Vec3 center = motion.begin[0];
        const Mat3 turn = random_rotation(random);
        for (std::size_t i = 0; i < motion.begin.size(); ++i)
            motion.end[i] = center + turn * (motion.begin[i] - center) + fall + (i < split ? drift : Vec3::Zero());
        const CcdResult result = motion.ccd(options);
        CHECK(result.iterations <= 25);
        impacts += result.toi != kNoImpact;
        for (int s = 0; s <= 50; ++s)
            CHECK(motion.distance(std::min(result.toi, 1.0) * s / 50) >= options.min_distance - 1e-15);
    }
    CHECK(impacts >= 100);
}

}  // namespace test_ccd_cost
