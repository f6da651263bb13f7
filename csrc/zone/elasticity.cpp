#include "zone/elasticity.hpp"

#include <cmath>

namespace diffsim {
namespace {

/// Functions as one, chosen by the type of their argument.
template <class... Functions>
struct Overloaded : Functions... {
    using Functions::operator()...;
};
template <class... Functions>
Overloaded(Functions...) -> Overloaded<Functions...>;

/// Call visit(index, cloth, parameters) for the zone's cloths.
template <class Visit>
void visit_cloths(const Zone& zone, const Visit& visit) {
    for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c)
        visit(c, zone.cloths[c], (*zone.cloth_parameters)[zone.cloths[c].id]);
}

}  // namespace

BlockPattern elastic_pattern(const Zone& zone) {
    BlockPattern pattern;
    pattern.node_count = zone.node_count();
    if (!zone.elastic) return pattern;
    for (std::size_t c = 0; c < zone.cloths.size(); ++c) {
        const int first = zone.cloths[c].first_node;
        for (const auto& [i, j] : zone.cloth(static_cast<int>(c)).node_pairs)
            pattern.node_pairs.emplace_back(first + i, first + j);
    }
    return pattern;
}

double elastic_energy(const Zone& zone, const std::vector<Vec3>& nodes) {
    double energy = 0.0;
    if (!zone.elastic) return energy;
    visit_cloths(zone, [&](int c, const ZoneCloth& cloth, const ClothParameters& parameters) {
        const Vec3* x = nodes.data() + cloth.first_node;
        energy += zone.dt * zone.dt * elastic_energy(zone.cloth(c), parameters, zone.dt, cloth.start, x);
    });
    return energy;
}

void add_elasticity(
    const Zone& zone, const ZonePoint& point, CutShare cut, ZoneDerivatives& derivatives, BlockSystem* system) {
    if (!zone.elastic) return;
    std::vector<Vec3>& gradient = derivatives.gradient.nodes;
    visit_cloths(zone, [&](int c, const ZoneCloth& cloth, const ClothParameters& parameters) {
        add_elastic_gradient(
            zone.cloth(c), parameters, zone.dt, cloth.start, point.nodes.data() + cloth.first_node, zone.dt * zone.dt,
            gradient.data() + cloth.first_node);
    });
    if (system != nullptr) add_elastic_hessian(zone, point, cut, *system);
}

void add_elastic_hessian(const Zone& zone, const ZonePoint& point, CutShare cut, BlockSystem& system) {
    const double scale = zone.dt * zone.dt;
    for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c) {
        const ZoneCloth& cloth = zone.cloths[c];
        const int first = cloth.first_node;
        const auto add = [&](int i, int j, const Mat3& block) {
            add_node_block(zone, first + i, first + j, block, system);
        };
        visit_elastic_hessian(
            zone.cloth(c), (*zone.cloth_parameters)[cloth.id], zone.dt, cloth.start, point.nodes.data() + first, cut,
            Overloaded{
                [&](const TriangleHessian& element) {
                    for (int r = 0; r < 3; ++r)
                        for (int s = r; s < 3; ++s)
                            add(element.nodes[r], element.nodes[s], scale * element.block(r, s));
                },
                [&](const HingeHessian& element) {
                    const int count = static_cast<int>(element.nodes.size());
                    for (int r = 0; r < 4; ++r) {
                        for (int s = r; s < 4; ++s) {
                            const Mat3 both = element.block(r, s) + element.block(s, r).transpose();
                            add(element.nodes[r], element.nodes[s], scale * both);
                        }
                        for (int s = 4; s < count; ++s)
                            add(element.nodes[r], element.nodes[s], scale * element.block(r, s));
                    }
                }});
    }
}

double elastic_force_sum(const Zone& zone, const ZonePoint& point, const BlockSystem& system) {
    // The elements' forces |f| = sqrt(2 k E), by Cauchy-Schwarz Σ |f| <= sqrt(2 Σk ΣE).
    double stiffness_sum = 0.0;
    for (int i = 0; i < zone.node_count(); ++i)
        if (!zone.nodes[i].pinned) stiffness_sum += system.node_diagonal(i).trace();
    return std::sqrt(2.0 * stiffness_sum * point.elastic_energy);
}

void add_elastic_backward(
    const Zone& zone, const ZonePoint& point, const std::vector<Vec3>& z, bool with_nodes, bool with_material,
    const ElasticGradient& gradient) {
    const double scale = -zone.dt * zone.dt;
    std::vector<Vec3> start;
    for (const ZoneNode& node : zone.nodes) start.push_back(node.start);
    visit_cloths(zone, [&](int c, const ZoneCloth& part, const ClothParameters& parameters) {
        const Vec3 *x = point.nodes.data() + part.first_node, *z_part = z.data() + part.first_node;
        if (with_nodes)
            add_elastic_hessian_product(
                zone.cloth(c), parameters, zone.dt, part.start, x, z_part, scale,
                gradient.nodes.data() + part.first_node);
        const bool through_damping = with_nodes && parameters.damping > 0.0;
        if (!with_material && !through_damping) return;
        gradient.cloths[static_cast<std::size_t>(c)] = add_elastic_backward(
            zone.cloth(c), parameters, zone.dt, part.start, x, start.data() + part.first_node, z_part, scale,
            gradient.start.data() + part.first_node);
    });
}

}  // namespace diffsim
