#pragma once

#include "zone/zone_derivatives.hpp"

/// The elastic term of a zone's energy: what strains its cloths (Straining, dynamics/cloth_elasticity.hpp). Where
/// Zone::elastic says so there is none.
namespace diffsim {

/// The pattern of its Hessian, nodes alone.
BlockPattern elastic_pattern(const Zone& zone);

double elastic_energy(const Zone& zone, const std::vector<Vec3>& nodes);

/// Add its derivatives, so much of the negative curvature cut off.
void add_elasticity(
    const Zone& zone, const ZonePoint& point, CutShare cut, ZoneDerivatives& derivatives, BlockSystem* system);

/// The Hessian alone, whatever Zone::elastic says. Pinned nodes are left out.
void add_elastic_hessian(const Zone& zone, const ZonePoint& point, CutShare cut, BlockSystem& system);

/// Add the exact Hessian times a direction, both one per node of the zone.
void add_elastic_product(
    const Zone& zone, const ZonePoint& point, const std::vector<Vec3>& direction, std::vector<Vec3>& product);

/// Bound on the sum of the elements' forces: what rounding of distances does to the energy is in proportion. `system`
/// holds the zone's last Hessian.
double elastic_force_sum(const Zone& zone, const ZonePoint& point, const BlockSystem& system);

/// Where gradients go.
struct ElasticGradient {
    std::vector<Vec3>& nodes;              ///< of where nodes are at the end of the step
    std::vector<Vec3>& start;              ///< of where they start, through the strains that damping is measured from
    std::vector<Vec3>& drive;              ///< of how far they go from where they start, if they end where they did
    std::vector<Vec3>& first_stage;        ///< of where they were at the end of a first stage
    std::vector<ClothParameters>& cloths;  ///< one per cloth of the zone
};

/// Add d(loss)/d(parameter) = -zᵀ d²(term)/dy d(parameter), z one per node, for those that are asked for.
void add_elastic_backward(
    const Zone& zone, const ZonePoint& point, const std::vector<Vec3>& z, bool with_nodes, bool with_material,
    const ElasticGradient& gradient);

}  // namespace diffsim
