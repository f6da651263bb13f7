// Cloths in the middle of a step, for the tests of their elastic energy.
#pragma once

#include <algorithm>
#include <type_traits>
#include <vector>

#include "cloth_fixtures.hpp"
#include "dynamics/cloth_elasticity.hpp"

namespace fixtures::elasticity {

inline constexpr double kDt = 0.01;  // [s]
inline constexpr double kRounding = 1e-13;
inline constexpr double kStretch = 3.0, kShear = 0.8, kBend = 0.2, kDamping = 0.005;

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

inline Cloth build(const TriangleMesh& mesh, const Vec3& warp = Vec3::UnitX(), double poisson = 0.0) {
    Cloth cloth = build_cloth(mesh.vertices, mesh.triangles, warp);
    cloth.poisson = poisson;
    return cloth;
}

inline Problem at_rest(const Cloth& cloth, const ClothParameters& parameters) {
    return {cloth, parameters, cloth.rest, cloth.rest};
}

/// Of one term of the energy or of all: neither rest, start nor end are flat, and every node is elsewhere in each.
enum class Term { stretch, shear, bend, all, all_undamped };

inline Problem random_problem(check::Random& random, Term term) {
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

inline double largest(const Nodes& values) {
    double result = 0.0;
    for (const Vec3& value : values) result = std::max(result, value.norm());
    return result;
}

inline Nodes mapped(Nodes x, const Mat3& map) { return moved(std::move(x), map, Vec3::Zero()); }

}  // namespace fixtures::elasticity
