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

/// The places that a cloth is strained to where the zone's nodes are at `nodes`: those themselves, or what the memory
/// `own` is filled with.
const Vec3* strained_places(
    const Zone& zone, const ZoneCloth& cloth, const std::vector<Vec3>& nodes, std::vector<Vec3>& own) {
    const Straining& straining = cloth.straining;
    const std::size_t first = static_cast<std::size_t>(cloth.first_node);
    if (straining.base_share == 0.0 && straining.share == 1.0) return nodes.data() + first;
    own.resize(straining.first_stage.size());
    for (std::size_t k = 0; k < own.size(); ++k) {
        const Vec3& start = zone.nodes[first + k].start;
        own[k] = start + straining.base_share * (straining.first_stage[k] - start) +
                 straining.share * (nodes[first + k] - start);
    }
    return own.data();
}

/// target += scale * part
void add_scaled(double scale, const std::vector<Vec3>& part, Vec3* target) {
    for (std::size_t k = 0; k < part.size(); ++k) target[k] += scale * part[k];
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
    std::vector<Vec3> own;
    visit_cloths(zone, [&](int c, const ZoneCloth& cloth, const ClothParameters& parameters) {
        const Straining& straining = cloth.straining;
        const Vec3* x = strained_places(zone, cloth, nodes, own);
        energy += straining.scale * elastic_energy(zone.cloth(c), parameters, straining.time, straining.start, x);
    });
    return energy;
}

void add_elasticity(
    const Zone& zone, const ZonePoint& point, CutShare cut, ZoneDerivatives& derivatives, BlockSystem* system) {
    if (!zone.elastic) return;
    std::vector<Vec3>& gradient = derivatives.gradient.nodes;
    std::vector<Vec3> own;
    visit_cloths(zone, [&](int c, const ZoneCloth& cloth, const ClothParameters& parameters) {
        const Straining& straining = cloth.straining;
        add_elastic_gradient(
            zone.cloth(c), parameters, straining.time, straining.start, strained_places(zone, cloth, point.nodes, own),
            straining.scale * straining.share, gradient.data() + cloth.first_node);
    });
    if (system != nullptr) add_elastic_hessian(zone, point, cut, *system);
}

void add_elastic_hessian(const Zone& zone, const ZonePoint& point, CutShare cut, BlockSystem& system) {
    std::vector<Vec3> own;
    for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c) {
        const ZoneCloth& cloth = zone.cloths[c];
        const Straining& straining = cloth.straining;
        const double scale = straining.scale * straining.share * straining.share;
        const int first = cloth.first_node;
        const auto add = [&](int i, int j, const Mat3& block) {
            add_node_block(zone, first + i, first + j, block, system);
        };
        visit_elastic_hessian(
            zone.cloth(c), (*zone.cloth_parameters)[cloth.id], straining.time, straining.start,
            strained_places(zone, cloth, point.nodes, own), cut,
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

void add_elastic_product(
    const Zone& zone, const ZonePoint& point, const std::vector<Vec3>& direction, std::vector<Vec3>& product) {
    std::vector<Vec3> own;
    visit_cloths(zone, [&](int c, const ZoneCloth& cloth, const ClothParameters& parameters) {
        const Straining& straining = cloth.straining;
        add_elastic_hessian_product(
            zone.cloth(c), parameters, straining.time, straining.start, strained_places(zone, cloth, point.nodes, own),
            direction.data() + cloth.first_node, straining.scale * straining.share * straining.share,
            product.data() + cloth.first_node);
    });
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
    std::vector<Vec3> own, start, places, strains;
    for (const ZoneNode& node : zone.nodes) start.push_back(node.start);
    visit_cloths(zone, [&](int c, const ZoneCloth& part, const ClothParameters& parameters) {
        const Cloth& cloth = zone.cloth(c);
        const Straining& straining = part.straining;
        const double scale = -straining.scale * straining.share;
        const Vec3 *x = strained_places(zone, part, point.nodes, own), *z_part = z.data() + part.first_node;
        Vec3* of_start = gradient.start.data() + part.first_node;
        Vec3* of_first_stage = gradient.first_stage.data() + part.first_node;
        if (with_nodes) {
            places.assign(static_cast<std::size_t>(cloth.node_count()), Vec3::Zero());
            add_elastic_hessian_product(
                cloth, parameters, straining.time, straining.start, x, z_part, scale, places.data());
            add_scaled(1.0 - straining.base_share, places, gradient.nodes.data() + part.first_node);
            add_scaled(straining.base_share, places, of_first_stage);
            add_scaled(straining.share - (1.0 - straining.base_share), places, gradient.drive.data() + part.first_node);
        }
        const bool through_damping = with_nodes && parameters.damping > 0.0;
        if (!with_material && !through_damping) return;
        const auto add_strains = [&](const Vec3* x_start, double share, Vec3* sum) {
            strains.assign(static_cast<std::size_t>(cloth.node_count()), Vec3::Zero());
            gradient.cloths[static_cast<std::size_t>(c)] = add_elastic_backward(
                cloth, parameters, straining.time, straining.start, x, x_start, z_part, scale, strains.data());
            add_scaled(share, strains, sum);
        };
        add_strains(start.data() + part.first_node, 1.0 - straining.start_share, of_start);
        if (through_damping && straining.start_share != 0.0)
            add_strains(straining.first_stage.data(), straining.start_share, of_first_stage);
    });
}

}  // namespace diffsim
