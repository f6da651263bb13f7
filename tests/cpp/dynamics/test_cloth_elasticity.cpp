#include "dynamics/cloth_elasticity.hpp"

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <type_traits>

#include "cloth_fixtures.hpp"

using namespace diffsim;
using fixtures::flatten_nodes;
using fixtures::kPi;
using fixtures::moved;
using fixtures::random_rotation;
using fixtures::random_vec3;
using fixtures::shaken;
using fixtures::TriangleMesh;
using fixtures::unflatten_nodes;

namespace {

constexpr double kDt = 0.01;  // [s]
constexpr double kRounding = 1e-13;

using Nodes = std::vector<Vec3>;

/// A cloth in the middle of a step. Sizes and stiffnesses of order 1, so that every term counts.
struct Problem {
    Cloth cloth;
    ClothParameters parameters;
    Nodes x_start, x;

    ElasticStart start() const { return elastic_start(cloth, x_start.data()); }
    double energy() const { return elastic_energy(cloth, parameters, kDt, start(), x.data()); }

    Nodes gradient(double scale = 1.0) const {
        Nodes result(x.size(), Vec3::Zero());
        add_elastic_gradient(cloth, parameters, kDt, start(), x.data(), scale, result.data());
        return result;
    }

    Nodes hessian_product(const Nodes& direction) const {
        Nodes result(x.size(), Vec3::Zero());
        add_elastic_hessian_product(cloth, parameters, kDt, start(), x.data(), direction.data(), 1.0, result.data());
        return result;
    }

    MatrixX hessian(CutShare cut) const {
        const Eigen::Index size = 3 * static_cast<Eigen::Index>(x.size());
        MatrixX result = MatrixX::Zero(size, size);
        const auto add = [&](int i, int j, const Mat3& block) { result.block<3, 3>(3 * i, 3 * j) += block; };
        visit_elastic_hessian(cloth, parameters, kDt, start(), x.data(), cut, [&](const auto& element) {
            const bool of_hinge = std::is_same_v<decltype(element), const HingeHessian&>;
            const int count = static_cast<int>(element.nodes.size());
            for (int i = 0; i < (of_hinge ? 4 : count); ++i) {
                for (int j = 0; j < count; ++j) {
                    add(element.nodes[i], element.nodes[j], element.block(i, j));
                    if (of_hinge) add(element.nodes[j], element.nodes[i], element.block(i, j).transpose());
                }
            }
        });
        return result;
    }

    Problem with_x(const VectorX& flat) const {
        Problem result = *this;
        result.x = unflatten_nodes(flat);
        return result;
    }
};

Cloth build(const TriangleMesh& mesh, const Vec3& warp = Vec3::UnitX(), double poisson = 0.0) {
    Cloth cloth = build_cloth(mesh.vertices, mesh.triangles, warp);
    cloth.poisson = poisson;
    return cloth;
}

constexpr double kStretch = 3.0, kShear = 0.8, kBend = 0.2, kDamping = 0.005;

Problem at_rest(const Cloth& cloth, const ClothParameters& parameters) {
    return {cloth, parameters, cloth.rest, cloth.rest};
}

/// Of one term of the energy or of all: neither rest, start nor end are flat, and every node is elsewhere in each.
enum class Term { stretch, shear, bend, all, all_undamped };

Problem random_problem(check::Random& random, Term term) {
    TriangleMesh mesh = fixtures::grid(3, 2, 0.7);
    mesh.vertices = shaken(mesh.vertices, random, 0.12);
    Problem problem;
    problem.cloth = build(mesh, {1.0, 0.4, 0.1}, 0.25);
    const bool all = term == Term::all || term == Term::all_undamped;
    problem.parameters.stretch = all || term == Term::stretch ? kStretch : 0.0;
    problem.parameters.shear = all || term == Term::shear ? kShear : 0.0;
    problem.parameters.bend = all || term == Term::bend ? kBend : 0.0;
    problem.parameters.damping = term == Term::all_undamped ? 0.0 : kDamping;
    problem.x_start = moved(shaken(mesh.vertices, random, 0.1), random_rotation(random), random_vec3(random));
    problem.x = shaken(problem.x_start, random, 0.08);
    return problem;
}

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

double largest(const Nodes& values) {
    double result = 0.0;
    for (const Vec3& value : values) result = std::max(result, value.norm());
    return result;
}

Nodes mapped(Nodes x, const Mat3& map) { return moved(std::move(x), map, Vec3::Zero()); }

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

// --- derivatives by x ------------------------------------------------------------------------------------------------

TEST(gradient_and_hessian_agree_with_differences) {
    check::Random random(4);
    for (const Term term : {Term::stretch, Term::shear, Term::bend, Term::all, Term::all_undamped}) {
        NOTE(term);
        for (int k = 0; k < 3; ++k) {
            const Problem problem = random_problem(random, term);
            const VectorX x = flatten_nodes(problem.x);
            const auto energy = [&](const VectorX& at) { return problem.with_x(at).energy(); };
            const auto slope = [&](const VectorX& at) { return flatten_nodes(problem.with_x(at).gradient()); };
            const VectorX gradient = flatten_nodes(problem.gradient());
            CHECK(gradient.norm() > 1e-2);
            CHECK_NEAR(gradient, fixtures::numeric_gradient(energy, x, 1e-4), 1e-9 * (1.0 + gradient.norm()));

            const MatrixX hessian = problem.hessian(kNothingCut);
            CHECK(hessian.norm() > 1e-1);
            CHECK_NEAR(hessian, MatrixX(hessian.transpose()), kRounding * hessian.norm());
            CHECK_NEAR(hessian, fixtures::numeric_jacobian(slope, x, 1e-4), 1e-8 * hessian.norm());

            const Nodes direction = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
            const VectorX product = hessian * flatten_nodes(direction);
            CHECK_NEAR(flatten_nodes(problem.hessian_product(direction)), product, kRounding * (1.0 + hessian.norm()));
        }
    }
}

TEST(sums_are_added_with_their_scale) {
    check::Random random(5);
    const Problem problem = random_problem(random, Term::all);
    const ElasticStart start = problem.start();
    const Nodes gradient = problem.gradient(), before = shaken(problem.x, random, 1.0);
    Nodes sum = before;
    add_elastic_gradient(problem.cloth, problem.parameters, kDt, start, problem.x.data(), -0.3, sum.data());
    for (std::size_t i = 0; i < sum.size(); ++i) CHECK_NEAR(sum[i], before[i] - 0.3 * gradient[i], kRounding * 10.0);
    const Nodes product = problem.hessian_product(before);
    sum = before;
    add_elastic_hessian_product(
        problem.cloth, problem.parameters, kDt, start, problem.x.data(), before.data(), -0.3, sum.data());
    for (std::size_t i = 0; i < sum.size(); ++i) CHECK_NEAR(sum[i], before[i] - 0.3 * product[i], kRounding * 100.0);
}

TEST(forces_and_torques_add_to_nothing) {
    check::Random random(6);
    for (const Term term : {Term::stretch, Term::shear, Term::bend, Term::all}) {
        NOTE(term);
        const Problem problem = random_problem(random, term);
        const Nodes gradient = problem.gradient();
        CHECK(largest(gradient) > 1e-2);
        Vec3 force = Vec3::Zero(), torque = Vec3::Zero();
        for (std::size_t i = 0; i < gradient.size(); ++i) {
            force += gradient[i];
            torque += problem.x[i].cross(gradient[i]);
        }
        CHECK_NEAR(force, Vec3(Vec3::Zero()), 10.0 * kRounding);
        CHECK_NEAR(torque, Vec3(Vec3::Zero()), 10.0 * kRounding);
    }
}

TEST(projected_triangles_are_semidefinite_and_exact_where_those_are) {
    check::Random random(7);
    int same = 0, different = 0;
    for (int k = 0; k < 30; ++k) {
        Problem problem = random_problem(random, k % 2 == 0 ? Term::all : Term::all_undamped);
        for (Vec3& node : problem.x) node *= 1.0 + 0.02 * (k - 15);  // crushed to stretched
        const ElasticStart start = problem.start();
        const ElasticLaw law = elastic_law(problem.cloth, problem.parameters, kDt);
        for (int t = 0; t < static_cast<int>(problem.cloth.triangles.size()); ++t) {
            const auto matrix = [&](CutShare cut) -> MatrixX {
                return triangle_hessian(problem.cloth, law, start, problem.x.data(), t, cut).matrix;
            };
            const MatrixX projected = matrix(kAllCut), exact = matrix(kNothingCut);
            const double size = exact.norm();
            const double lowest = Eigen::SelfAdjointEigenSolver<MatrixX>(projected).eigenvalues()[0];
            const double lowest_exact = Eigen::SelfAdjointEigenSolver<MatrixX>(exact).eigenvalues()[0];
            CHECK(lowest > -kRounding * size);
            if (lowest_exact > -kRounding * size) {
                CHECK_NEAR(projected, exact, kRounding * size);
                ++same;
            } else {
                CHECK((projected - exact).norm() > kRounding * size);
                ++different;
            }
        }
    }
    CHECK(same >= 50);
    CHECK(different >= 100);
}

TEST(the_projected_hessian_is_semidefinite) {
    check::Random random(12);
    int indefinite = 0;
    for (int k = 0; k < 20; ++k) {
        const Problem problem = random_problem(random, k % 2 == 0 ? Term::bend : Term::all);
        const auto lowest = [&](CutShare cut) {
            const Eigen::SelfAdjointEigenSolver<MatrixX> eigen(problem.hessian(cut));
            return eigen.eigenvalues()[0] / eigen.eigenvalues().tail(1)[0];
        };
        CHECK(lowest(kAllCut) > -kRounding);
        indefinite += lowest(kNothingCut) < -1e-6 ? 1 : 0;
    }
    CHECK(indefinite >= 15);
}

TEST(a_share_of_the_cut_lies_between_nothing_and_all) {
    check::Random random(13);
    const Problem problem = random_problem(random, Term::all);
    const MatrixX exact = problem.hessian(kNothingCut), projected = problem.hessian(kAllCut);
    CHECK((projected - exact).norm() > 1e-3 * exact.norm());
    CHECK_NEAR(problem.hessian(0.25), MatrixX(0.75 * exact + 0.25 * projected), kRounding * exact.norm());
}

TEST(a_flat_sheet_under_tension_needs_no_projection) {
    Problem problem = at_rest(build(fixtures::grid(3, 3, 0.5)), {0.1, kStretch, kShear, kBend, kDamping});
    problem.x = mapped(problem.cloth.rest, Vec3(1.1, 1.2, 1.0).asDiagonal());
    CHECK(problem.hessian(kAllCut) == problem.hessian(kNothingCut));
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

// --- backward --------------------------------------------------------------------------------------------------------

TEST(elastic_backward_agrees_with_differences) {
    check::Random random(10);
    const double scale = 0.7;
    for (int k = 0; k < 5; ++k) {
        const Problem problem = random_problem(random, Term::all);
        const Nodes direction = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
        const VectorX z = flatten_nodes(direction);
        const auto s = [&](const Problem& at) { return z.dot(flatten_nodes(at.gradient(scale))); };

        const Nodes before = shaken(problem.x, random, 1.0);
        Nodes sum = before;
        const ClothParameters grad = add_elastic_backward(
            problem.cloth, problem.parameters, kDt, problem.start(), problem.x.data(), problem.x_start.data(),
            direction.data(), scale, sum.data());
        const VectorX grad_x_start = flatten_nodes(sum) - flatten_nodes(before);
        const auto by_x_start = [&](const VectorX& x_start) {
            Problem moved_start = problem;
            moved_start.x_start = unflatten_nodes(x_start);
            return s(moved_start);
        };
        CHECK(grad_x_start.norm() > 1e-2);
        CHECK_NEAR(
            grad_x_start, fixtures::numeric_gradient(by_x_start, flatten_nodes(problem.x_start), 1e-4),
            1e-8 * grad_x_start.norm());

        CHECK(grad.density == 0.0);
        const std::pair<double ClothParameters::*, double> fields[] = {
            {&ClothParameters::stretch, grad.stretch},
            {&ClothParameters::shear, grad.shear},
            {&ClothParameters::bend, grad.bend},
            {&ClothParameters::damping, grad.damping}};
        for (const auto& [field, analytic] : fields) {
            const auto by_field = [&, member = field](const VectorX& value) {
                Problem changed = problem;
                changed.parameters.*member = value[0];
                return s(changed);
            };
            const VectorX numeric =
                fixtures::numeric_gradient(by_field, VectorX::Constant(1, problem.parameters.*field), 1e-3);
            CHECK(std::abs(analytic) > 1e-3);
            CHECK_NEAR(analytic, numeric[0], 1e-9 * (1.0 + std::abs(analytic)));  // s is linear in each
        }
    }
}

TEST(undamped_steps_still_know_their_gradient_by_damping) {
    check::Random random(11);
    const Problem problem = random_problem(random, Term::all_undamped);
    const Nodes direction = shaken(Nodes(problem.x.size(), Vec3::Zero()), random, 1.0);
    Nodes grad_x_start(problem.x.size(), Vec3::Zero());
    const ClothParameters grad = add_elastic_backward(
        problem.cloth, problem.parameters, kDt, problem.start(), problem.x.data(), problem.x_start.data(),
        direction.data(), 1.0, grad_x_start.data());
    CHECK(largest(grad_x_start) == 0.0);
    const auto s = [&](double damping) {
        Problem changed = problem;
        changed.parameters.damping = damping;
        return flatten_nodes(direction).dot(flatten_nodes(changed.gradient()));
    };
    CHECK(std::abs(grad.damping) > 1e-3);
    CHECK_NEAR(grad.damping, s(1.0) - s(0.0), 1e-10 * std::abs(grad.damping));
}

// --- degenerate shapes -----------------------------------------------------------------------------------------------

TEST(collapsed_sheets_have_finite_forces) {
    const Cloth cloth = build(fixtures::grid(3, 3, 0.5), {1, 0.2, 0}, 0.2);
    const Problem rest = at_rest(cloth, {0.1, kStretch, kShear, kBend, kDamping});
    const std::vector<Mat3> maps = {
        Mat3::Zero(), Vec3(1, 0, 0).asDiagonal(), Vec3(0, 1, 0).asDiagonal(), Vec3(1, 1e-8, 0).asDiagonal(),
        Vec3(1e-30, 1e-30, 0).asDiagonal()};
    for (const Mat3& map : maps) {
        NOTE(map);
        for (const bool at_start : {false, true}) {
            Problem problem = rest;
            (at_start ? problem.x_start : problem.x) = mapped(cloth.rest, map);
            CHECK(std::isfinite(problem.energy()));
            CHECK(flatten_nodes(problem.gradient()).allFinite());
            CHECK(problem.hessian(kNothingCut).allFinite());
            CHECK(problem.hessian(kAllCut).allFinite());
            CHECK(flatten_nodes(problem.hessian_product(cloth.rest)).allFinite());
            Nodes grad_x_start(cloth.rest.size(), Vec3::Zero());
            const ClothParameters grad = add_elastic_backward(
                cloth, problem.parameters, kDt, problem.start(), problem.x.data(), problem.x_start.data(),
                cloth.rest.data(), 1.0, grad_x_start.data());
            CHECK(flatten_nodes(grad_x_start).allFinite());
            CHECK(std::isfinite(grad.stretch + grad.shear + grad.bend + grad.damping));
        }
    }
}

TEST(a_collapsed_hinge_contributes_nothing) {
    Problem problem = at_rest(build(fixtures::folded_pair(0.5)), {0.1, 0.0, 0.0, kBend, kDamping});
    problem.x = fixtures::folded_pair(-0.5).vertices;
    CHECK(problem.energy() > 1e-2);
    problem.x[2] = Vec3(0.4, 0.0, 0.0);
    CHECK(problem.energy() == 0.0);
    CHECK(largest(problem.gradient()) == 0.0);
    CHECK(problem.hessian(kNothingCut).isZero(0.0));
}
