#include "dynamics/cloth_elasticity.hpp"

#include <cmath>

#include "elasticity_fixtures.hpp"

namespace test_cloth_elasticity {

using namespace diffsim;
using namespace fixtures::elasticity;
using fixtures::kPi;
using fixtures::moved;
using fixtures::random_rotation;
using fixtures::random_vec3;
using fixtures::shaken;
using fixtures::TriangleMesh;

namespace {

/// The energy written down as in the header, without the kernel's shortcuts.
double obvious_energy(const Problem& problem) {
    const ClothParameters& p = problem.parameters;
    const double nu = problem.cloth.poisson;
    Mat3 C = Mat3::Zero();  // on (ε11, ε22, 2 ε12)
    C(0, 0) = C(1, 1) = p.stretch / (1.0 - nu * nu);
    C(0, 1) = C(1, 0) = nu * C(0, 0);
    C(2, 2) = p.shear;
    const auto strain = [](const ClothTriangle& t, const Nodes& x) -> Vec3 {
        Eigen::Matrix<double, 3, 2> edges;
        edges << x[t.nodes[1]] - x[t.nodes[0]], x[t.nodes[2]] - x[t.nodes[0]];
        const Eigen::Matrix<double, 3, 2> F = edges * t.rest_inverse;
        const Eigen::Matrix2d E = 0.5 * (F.transpose() * F - Eigen::Matrix2d::Identity());
        return {E(0, 0), E(1, 1), 2.0 * E(0, 1)};
    };
    const auto angle = [](const ClothHinge& h, const Nodes& x) {
        const Vec3 p0 = x[h.nodes[0]], edge = x[h.nodes[1]] - p0;
        const Vec3 normal_a = edge.cross(x[h.nodes[2]] - p0), normal_b = (x[h.nodes[3]] - p0).cross(edge);
        return std::atan2(normal_a.cross(normal_b).dot(edge.normalized()), normal_a.dot(normal_b));
    };
    MatrixX weights = MatrixX::Zero(problem.cloth.hinges.size(), problem.cloth.hinges.size());
    VectorX bent(weights.rows()), turned(weights.rows());
    for (int h = 0; h < weights.rows(); ++h) {
        const ClothHinge& hinge = problem.cloth.hinges[h];
        const double now = angle(hinge, problem.x);
        weights(h, h) = hinge.weight;
        bent[h] = std::remainder(now - hinge.rest_angle, 2.0 * kPi);
        turned[h] = std::remainder(now - angle(hinge, problem.x_start), 2.0 * kPi);
    }
    for (const HingeCoupling& c : problem.cloth.couplings) weights(c.a, c.b) = weights(c.b, c.a) = c.weight;
    double energy = 0.0;
    for (const ClothTriangle& t : problem.cloth.triangles) {
        const Vec3 now = strain(t, problem.x), change = now - strain(t, problem.x_start);
        energy += 0.5 * t.area * (now.dot(C * now) + p.damping / kDt * change.dot(C * change));
    }
    energy += 0.5 * p.bend * (bent.dot(weights * bent) + p.damping / kDt * turned.dot(weights * turned));
    return energy;
}

}  // namespace

// --- the energy ------------------------------------------------------------------------------------------------------

TEST(energy_is_the_one_written_down) {
    check::Random random(1);
    for (const Term term : {Term::stretch, Term::shear, Term::bend, Term::all, Term::all_undamped}) {
        NOTE(term);
        for (int k = 0; k < 10; ++k) {
            const Problem problem = random_problem(random, term);
            const double expected = obvious_energy(problem);
            CHECK(expected > 1e-5);
            CHECK_NEAR(problem.energy(), expected, kRounding * (1.0 + expected));
        }
    }
}

TEST(uniaxial_stretch_with_poisson) {
    const double nu = 0.3, area = 12.0;
    for (const double e11 : {-0.2, 1e-3, 0.5}) {
        NOTE(e11);
        Problem problem = at_rest(build(fixtures::grid(4, 3, 1.0), Vec3::UnitX(), nu), {0.1, 50.0, 7.0, 0.1, 0.0});
        const double stretched = std::sqrt(1.0 + 2.0 * e11);
        // Held across: both strains of plane stress.
        problem.x = mapped(problem.cloth.rest, Vec3(stretched, 1.0, 1.0).asDiagonal());
        CHECK_NEAR(problem.energy(), 0.5 * 50.0 / (1.0 - nu * nu) * e11 * e11 * area, 1e-11);
        // Free across it contracts by ν: the stress there vanishes, and stretch alone is left.
        problem.x = mapped(problem.cloth.rest, Vec3(stretched, std::sqrt(1.0 - 2.0 * nu * e11), 1.0).asDiagonal());
        CHECK_NEAR(problem.energy(), 0.5 * 50.0 * e11 * e11 * area, 1e-11);
        const Nodes gradient = problem.gradient();
        double pull = 0.0;
        for (std::size_t i = 0; i < gradient.size(); ++i) {
            CHECK_NEAR(gradient[i].y(), 0.0, 1e-11);
            if (i % 5 == 4) pull += gradient[i].x();
        }
        CHECK_NEAR(pull, 50.0 * e11 * stretched * 3.0, 1e-11);  // the end of width 3
    }
}

TEST(simple_shear) {
    const double gamma = 0.2, area = 12.0;
    Mat3 map = Mat3::Identity();
    map(0, 1) = gamma;
    Problem problem = at_rest(build(fixtures::grid(4, 3, 1.0)), {0.1, 50.0, 7.0, 0.1, 0.0});
    problem.x = mapped(problem.cloth.rest, map);
    const double e22 = 0.5 * gamma * gamma;
    CHECK_NEAR(problem.energy(), (0.5 * 7.0 * gamma * gamma + 0.5 * 50.0 * e22 * e22) * area, 1e-12);
}

TEST(the_warp_turns_the_law) {
    // Stretch along x of a cloth whose warp lies at 45°: ε11 = ε22 = ε12 = ½ ε of the axes of x.
    const double e = 0.1, area = 12.0;
    Problem problem = at_rest(build(fixtures::grid(4, 3, 1.0), {1, 1, 0}), {0.1, 50.0, 7.0, 0.1, 0.0});
    problem.x = mapped(problem.cloth.rest, Vec3(std::sqrt(1.0 + 2.0 * e), 1.0, 1.0).asDiagonal());
    CHECK_NEAR(problem.energy(), (0.5 * 50.0 * 2.0 * 0.25 * e * e + 0.5 * 7.0 * e * e) * area, 1e-12);
}

TEST(a_grid_rolled_onto_a_cylinder) {
    const int nx = 8, ny = 5;
    const double h = 0.1, curvature = 1.3, bend = 0.7;
    for (const bool along_x : {true, false}) {
        NOTE(along_x);
        Problem problem = at_rest(build(fixtures::grid(nx, ny, h)), {0.1, 0.0, 0.0, bend, 0.0});
        for (Vec3& node : problem.x) {
            const double arc = along_x ? node.x() : node.y();
            const double in = std::sin(curvature * arc) / curvature, up = (1.0 - std::cos(curvature * arc)) / curvature;
            node = along_x ? Vec3(in, node.y(), up) : Vec3(node.x(), in, up);
        }
        // All but half a column at each end belongs to a hinge. Chords of equal arcs meet at κ h.
        const double area = h * h * (along_x ? (nx - 1) * ny : nx * (ny - 1));
        CHECK_NEAR(problem.energy(), 0.5 * bend * curvature * curvature * area, kRounding);
    }
}

TEST(rigid_motion_costs_nothing) {
    check::Random random(2);
    Mat3 quarter = Mat3::Zero();
    quarter(0, 1) = quarter(2, 0) = -1.0;
    quarter(1, 2) = 1.0;
    for (const Mat3& R : {Mat3(Mat3::Identity()), quarter, Mat3(quarter * quarter), random_rotation(random)}) {
        Problem problem = random_problem(random, Term::all);
        CHECK(problem.energy() > 1e-2);
        problem.x_start = problem.cloth.rest;
        problem.x = moved(problem.cloth.rest, R, {3.0, -1.0, 2.0});
        CHECK_NEAR(problem.energy(), 0.0, 1e-26);  // of squares of rounding errors
        CHECK(largest(problem.gradient()) < kRounding);
    }
}

TEST(angles_take_the_short_way_round) {
    const double rest = kPi - 0.2, now = -kPi + 0.1;
    Problem problem = at_rest(build(fixtures::folded_pair(rest)), {0.1, 0.0, 0.0, 1.0, kDamping});
    problem.x = fixtures::folded_pair(now).vertices;
    const double expected = fixtures::kFoldedPairWeight * 0.5 * (1.0 + kDamping / kDt) * 0.3 * 0.3;
    CHECK_NEAR(problem.energy(), expected, kRounding);
    // The corner swings about the edge at the distance 1, so that its force is the moment, and pulls the angle down.
    const Vec3 upward = (fixtures::folded_pair(now + 1e-6).vertices[3] - problem.x[3]).normalized();
    CHECK_NEAR(problem.gradient()[3].dot(upward), fixtures::kFoldedPairWeight * (1.0 + kDamping / kDt) * 0.3, 1e-6);
    problem.x_start = problem.x;
    CHECK_NEAR(problem.energy(), fixtures::kFoldedPairWeight * 0.5 * 0.3 * 0.3, kRounding);
    CHECK_NEAR(problem.gradient()[3].dot(upward), fixtures::kFoldedPairWeight * 0.3, 1e-6);
}

TEST(numbering_does_not_matter) {
    check::Random random(3);
    const Problem problem = random_problem(random, Term::all);
    const int node_count = problem.cloth.node_count();
    std::vector<Eigen::Vector3i> triangles;
    for (const ClothTriangle& t : problem.cloth.triangles) triangles.emplace_back(t.nodes[0], t.nodes[1], t.nodes[2]);
    const double energy = problem.energy();
    const Nodes gradient = problem.gradient();
    for (int k = 0; k < 20; ++k) {
        NOTE(k);
        std::vector<int> name(problem.x.size());
        for (int i = 0; i < node_count; ++i) name[i] = i;
        for (int i = node_count - 1; i > 0; --i)
            std::swap(name[i], name[static_cast<int>(random.uniform(0.0, i + 1.0))]);
        TriangleMesh mesh{problem.cloth.rest, triangles};
        for (int i = static_cast<int>(triangles.size()) - 1; i > 0; --i)
            std::swap(mesh.triangles[i], mesh.triangles[static_cast<int>(random.uniform(0.0, i + 1.0))]);
        for (Eigen::Vector3i& t : mesh.triangles) {
            if (random.uniform() < 0.0) std::swap(t[0], t[1]);
            if (random.uniform() < 0.0) std::swap(t[1], t[2]);
            for (int& node : t) node = name[node];
        }
        Problem renamed = problem;
        for (int i = 0; i < node_count; ++i) {
            mesh.vertices[name[i]] = problem.cloth.rest[i];
            renamed.x_start[name[i]] = problem.x_start[i];
            renamed.x[name[i]] = problem.x[i];
        }
        renamed.cloth = build(mesh, {1.0, 0.4, 0.1}, problem.cloth.poisson);
        CHECK_NEAR(renamed.energy(), energy, kRounding * energy);
        const Nodes renamed_gradient = renamed.gradient();
        for (int i = 0; i < node_count; ++i) CHECK_NEAR(renamed_gradient[name[i]], gradient[i], 10.0 * kRounding);
    }
}

// --- damping ---------------------------------------------------------------------------------------------------------

TEST(damping_is_silent_without_deformation) {
    check::Random random(8);
    Problem problem = random_problem(random, Term::all);
    Problem undamped = problem;
    undamped.parameters.damping = 0.0;
    CHECK(problem.energy() > 1.01 * undamped.energy());
    problem.x = undamped.x = problem.x_start;
    CHECK(problem.energy() == undamped.energy());
    CHECK(problem.gradient() == undamped.gradient());
    problem.x = undamped.x = moved(problem.x_start, random_rotation(random), random_vec3(random));
    const Nodes gradient = problem.gradient(), expected = undamped.gradient();
    for (std::size_t i = 0; i < gradient.size(); ++i) CHECK_NEAR(gradient[i], expected[i], 10.0 * kRounding);
}

TEST(damping_opposes_motion) {
    check::Random random(9);
    for (int k = 0; k < 20; ++k) {
        Problem problem = random_problem(random, Term::all);
        const Nodes velocity = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
        for (std::size_t i = 0; i < velocity.size(); ++i) problem.x[i] = problem.x_start[i] + 1e-3 * velocity[i];
        Problem undamped = problem;
        undamped.parameters.damping = 0.0;
        const Nodes with = problem.gradient(), without = undamped.gradient();
        double power = 0.0;  // taken out of the motion
        for (std::size_t i = 0; i < velocity.size(); ++i) power += velocity[i].dot(with[i] - without[i]);
        CHECK(power > 1e-4);
    }
}

TEST(damping_relaxes_over_its_time) {
    // Held against its stress, a strip creeps by dε/dt = -ε / damping; one step of implicit Euler divides by
    // 1 + dt / damping, where the energy of the step is least.
    Problem problem = at_rest(build(fixtures::grid(2, 1, 1.0)), {0.1, 50.0, 7.0, 0.0, 0.02});
    const double e_start = 1e-2, e_end = e_start / (1.0 + kDt / 0.02);
    problem.x_start = mapped(problem.cloth.rest, Vec3(std::sqrt(1.0 + 2.0 * e_start), 1.0, 1.0).asDiagonal());
    problem.x = mapped(problem.cloth.rest, Vec3(std::sqrt(1.0 + 2.0 * e_end), 1.0, 1.0).asDiagonal());
    CHECK(largest(problem.gradient()) < kRounding * 50.0);
}

}  // namespace test_cloth_elasticity
