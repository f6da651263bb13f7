#include "zone/zone.hpp"

#include <algorithm>
#include <cmath>
#include <iterator>
#include <optional>
#include <type_traits>

#include "math/positive_part.hpp"
#include "math/rotation.hpp"
#include "zone/contact_assembly.hpp"
#include "zone/contact_memory.hpp"
#include "zone/motion_bounds.hpp"
#include "zone/sides_of.hpp"

namespace diffsim {
namespace {

/// Functions as one, chosen by the type of their argument.
template <class... Functions>
struct Overloaded : Functions... {
    using Functions::operator()...;
};
template <class... Functions>
Overloaded(Functions...) -> Overloaded<Functions...>;

void sort_unique(IndexPairs& pairs) {
    std::sort(pairs.begin(), pairs.end());
    pairs.erase(std::unique(pairs.begin(), pairs.end()), pairs.end());
}

/// Inertia and elasticity of cloth: gradient and, if asked for, Hessian.
void add_cloth(
    const Zone& zone, const ZonePoint& point, CutShare cut, ZoneDerivatives& derivatives, BlockSystem* system) {
    const double scale = zone.dt * zone.dt;
    std::vector<Vec3>& gradient = derivatives.gradient.nodes;
    if (zone.elastic) {
        for (int c = 0; c < static_cast<int>(zone.cloths.size()); ++c) {
            const ZoneCloth& cloth = zone.cloths[c];
            add_elastic_gradient(
                zone.cloth(c), (*zone.cloth_parameters)[cloth.id], zone.dt, cloth.start,
                point.nodes.data() + cloth.first_node, scale, gradient.data() + cloth.first_node);
        }
        if (system != nullptr) add_elastic_hessian(zone, point, cut, *system);
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        const ZoneNode& node = zone.nodes[i];
        if (node.pinned) {
            gradient[i].setZero();
        } else {
            derivatives.largest_force = std::max(derivatives.largest_force, gradient[i].norm() / std::sqrt(node.mass));
            gradient[i] += node.mass * (point.y.nodes[i] - node.target);
        }
        if (system == nullptr) continue;
        Mat3& block = system->node_diagonal(i);
        if (node.pinned) {
            block.setIdentity();
            continue;
        }
        derivatives.largest_stiffness = std::max(derivatives.largest_stiffness, block.trace() / std::sqrt(node.mass));
        block.diagonal().array() += node.mass;
    }
}

}  // namespace

void add_node_block(const Zone& zone, int i, int j, const Mat3& block, BlockSystem& system) {
    if (zone.nodes[i].pinned || zone.nodes[j].pinned) return;
    if (i == j)
        system.node_diagonal(i) += block;
    else if (i < j)
        system.node_pair(system.find_node_pair(i, j)) += block;
    else
        system.node_pair(system.find_node_pair(j, i)) += block.transpose();
}

Pose pose_at(const ZoneBody& body, const Vec6& y) {
    if (y.isZero(0.0)) return body.start;
    return {exp_rotation(y.head<3>()) * body.start.R, body.start.t + y.tail<3>()};
}

Zone& make_zone(
    Zone& zone, const Model& model, const std::vector<ClothParameters>& cloths, double compliance, double dt,
    const Vec3& origin) {
    zone.nodes.clear();
    zone.cloths.clear();
    zone.dynamic_count = 0;
    zone.model = &model;
    zone.cloth_parameters = &cloths;
    zone.exact_contact = compliance == 0.0;
    zone.compliance = zone.exact_contact ? kDefaultCompliance : compliance;
    forget_contacts(zone);
    zone.dt = dt;
    zone.origin = origin;
    zone.ground_height = model.ground.height - origin.z();
    zone.elastic = true;
    zone.contacts_off = false;
    return zone;
}

namespace {

/// Have the vertices of a body's feature placed with the zone.
void list_vertices(Zone& zone, int body, const Feature& feature) {
    FeatureVertices& vertices = zone.contacts.vertices;
    while (static_cast<int>(vertices.first.size()) <= body) {
        const std::size_t first = vertices.listed.size();
        const std::size_t count = zone.mesh(static_cast<int>(vertices.first.size())).vertices.size();
        vertices.first.push_back(static_cast<int>(first));
        vertices.listed.resize(first + count, 0);
    }
    const auto list = [&](int vertex) {
        char& listed = vertices.listed[static_cast<std::size_t>(vertices.first[body] + vertex)];
        if (!listed) vertices.entries.push_back({body, vertex});
        listed = 1;
    };
    const CollisionMesh& mesh = zone.mesh(body);
    if (feature.kind == FeatureKind::patch) {
        for (int vertex : mesh.patches[feature.index].vertices) list(vertex);
        return;
    }
    for (int vertex : feature_vertices(mesh, feature))
        if (vertex >= 0) list(vertex);
}

}  // namespace

void list_feature_vertices(Zone& zone, const ZoneContact& contact) {
    if (contact.contact.with_ground()) return;
    const auto list = [&](const auto& side) {
        if constexpr (std::is_same_v<decltype(side), const SideOfBody&>)
            list_vertices(zone, side.body(), side.feature());
    };
    with_sides(zone, contact, [&](const auto& a, const auto& b) {
        list(a);
        list(b);
    });
}

ContactGeometry contact_geometry(
    const Zone& zone, const ZoneContact& contact, const std::vector<Pose>& poses, const std::vector<Vec3>& nodes) {
    return with_sides(zone, contact, [&](const auto& a, const auto& b) -> ContactGeometry {
        return {contact.contact, a.surface(poses, nodes), b.surface(poses, nodes), zone.ground_height};
    });
}

Mat6 chart_jacobian(const Vec6& y) {
    Mat6 jacobian = Mat6::Identity();
    jacobian.topLeftCorner<3, 3>() = left_jacobian(y.head<3>());
    return jacobian;
}

Mat3 chart_curvature(const Vec6& y, const Vec3& torque) {
    // The gradient is Jᵀ torque; along a turn phi = J dtheta the torque changes by (H - ½ [torque]x) phi, H symmetric.
    const Vec3 theta = y.head<3>();
    const Mat3 J = left_jacobian(theta);
    const Mat3 full = left_jacobian_transposed_derivative(theta, torque) - 0.5 * J.transpose() * skew(torque) * J;
    return 0.5 * (full + full.transpose());
}

void place(const Zone& zone, const Coordinates& y, std::vector<Pose>& poses, std::vector<Vec3>& nodes) {
    poses.resize(zone.bodies.size());
    for (std::size_t i = 0; i < zone.bodies.size(); ++i) poses[i] = pose_at(zone.bodies[i], y.bodies[i]);
    nodes.resize(zone.nodes.size());
    for (std::size_t i = 0; i < zone.nodes.size(); ++i) nodes[i] = zone.nodes[i].start + y.nodes[i];
}

namespace {

void place_vertices(const Zone& zone, ZonePoint& point) {
    const FeatureVertices& vertices = zone.contacts.vertices;
    point.vertices.resize(vertices.listed.size());
    for (const auto& [body, vertex] : vertices.entries)
        point.vertices[vertices.first[body] + vertex] = point.poses[body] * zone.mesh(body).vertices[vertex];
}

double inertial_energy(const Zone& zone, const Coordinates& y) {
    double energy = 0.0;
    for (int i = 0; i < zone.dynamic_count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        const Vec6 error = y.bodies[i] - body.target;
        energy +=
            0.5 * (error.head<3>().dot(body.inertia * error.head<3>()) + body.mass * error.tail<3>().squaredNorm());
    }
    for (int i = 0; i < zone.node_count(); ++i) {
        const ZoneNode& node = zone.nodes[i];
        if (!node.pinned) energy += 0.5 * node.mass * (y.nodes[i] - node.target).squaredNorm();
    }
    return energy;
}

double elastic_energy(const Zone& zone, const std::vector<Vec3>& nodes) {
    double energy = 0.0;
    for (int c = 0; zone.elastic && c < static_cast<int>(zone.cloths.size()); ++c) {
        const ZoneCloth& cloth = zone.cloths[c];
        energy += zone.dt * zone.dt *
                  elastic_energy(
                      zone.cloth(c), (*zone.cloth_parameters)[cloth.id], zone.dt, cloth.start,
                      nodes.data() + cloth.first_node);
    }
    return energy;
}

}  // namespace

namespace {

/// Find the distance of a contact, and add what it pushes with.
template <class A, class B>
void look_at(const Zone& zone, std::size_t k, const ZoneContact& contact, const A& a, const B& b, ZonePoint& point) {
    constexpr bool kBodyOnGround = std::is_same_v<A, SideOfBody> && std::is_same_v<B, SideOfGround>;
    Surface surface;
    if constexpr (kBodyOnGround) {
        const Pose& pose = point.poses[a.body()];
        const double height = pose.R.row(2).dot(a.mesh().vertices[a.feature().index]) + pose.t.z() - zone.ground_height;
        point.distances[k] = height;
        if (!(height < contact.law.range.rest)) return;
        surface = a.surface(point.poses, point.nodes);
    } else {
        surface = a.surface(point);
    }
    // Made where it stays if it is active.
    const ContactGeometry& geometry =
        point.active.emplace_back(static_cast<int>(k), contact.contact, surface, b.surface(point), zone.ground_height)
            .geometry;
    point.distances[k] = geometry.distance;
    if (geometry.distance < contact.law.range.rest)
        point.contact_energy += contact_energy(geometry, contact.law);
    else
        point.active.pop_back();
}

}  // namespace

void evaluate(const Zone& zone, ZonePoint& point, const ZonePoint* before) {
    place(zone, point.y, point.poses, point.nodes);
    place_vertices(zone, point);
    const double inertial = inertial_energy(zone, point.y);
    point.elastic_energy = elastic_energy(zone, point.nodes);
    point.distances.resize(zone.contacts.size());
    point.active.clear();
    point.contact_energy = 0.0;
    std::optional<MotionBounds> motion;
    if (before != nullptr) motion.emplace(zone, before->y, point.y);
    for (std::size_t k = 0; k < zone.contacts.size(); ++k) {
        const ZoneContact& contact = zone.contacts[k];
        if (motion) {
            const double at_least = before->distances[k] - motion->approach(contact);
            if (at_least > contact.law.range.rest) {
                point.distances[k] = at_least;
                continue;
            }
        }
        with_sides(zone, contact, [&](const auto& a, const auto& b) { look_at(zone, k, contact, a, b, point); });
    }
    point.energy = inertial + point.elastic_energy + point.contact_energy;
}

BlockPattern cloth_pattern(const Zone& zone) {
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

BlockPattern base_pattern(const Zone& zone) {
    BlockPattern pattern = cloth_pattern(zone);
    pattern.body_count = zone.dynamic_count;
    pattern.body_pairs = zone.contacts.blocks;
    return pattern;
}

void ensure_pattern(const Zone& zone, const std::vector<int>& contacts, BlockSystem& system) {
    if (zone.nodes.empty()) return;
    IndexPairs mixed, nodes;
    const auto couple = [&](int i, int j) {
        if (zone.nodes[i].pinned || zone.nodes[j].pinned) return;
        const std::pair<int, int> pair(std::min(i, j), std::max(i, j));
        if (system.find_node_pair(pair.first, pair.second) < 0) nodes.push_back(pair);
    };
    for (int index : contacts) {
        const ZoneContact& contact = zone.contacts[index];
        if (contact.contact.with_ground()) continue;
        std::array<int, 6> touched;
        int count = 0, body = kNobody;
        visit_movers(
            zone, contact, [&](int moved) { body = moved; },
            [&](int node) { touched[static_cast<std::size_t>(count++)] = node; });
        for (int i = 0; i < count; ++i) {
            const int node = touched[static_cast<std::size_t>(i)];
            for (int j = i + 1; j < count; ++j) couple(node, touched[static_cast<std::size_t>(j)]);
            if (zone.yields(body) && !zone.nodes[node].pinned && system.find_mixed_pair(body, node) < 0)
                mixed.emplace_back(body, node);
        }
    }
    if (mixed.empty() && nodes.empty()) return;
    BlockPattern pattern = system.pattern();
    const auto merge = [](IndexPairs& into, IndexPairs& more) {
        sort_unique(more);
        IndexPairs merged;
        merged.reserve(into.size() + more.size());
        std::merge(into.begin(), into.end(), more.begin(), more.end(), std::back_inserter(merged));
        into = std::move(merged);
    };
    merge(pattern.mixed_pairs, mixed);
    merge(pattern.node_pairs, nodes);
    system.set_pattern(std::move(pattern));
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

namespace {

void set_zero(const Zone& zone, ZoneDerivatives& derivatives) {
    const std::size_t count = static_cast<std::size_t>(zone.dynamic_count);
    derivatives.gradient.assign_zero(count, zone.nodes.size());
    derivatives.torque.resize(count);
    derivatives.jacobian.resize(count);
    derivatives.body_contacts.clear();
    derivatives.largest_force = derivatives.largest_stiffness = 0.0;
}

/// What contacts do to bodies, from twists to coordinates, and inertia and elasticity.
void end_differentiation(
    const Zone& zone, const ZonePoint& point, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system,
    CutShare cut) {
    const int count = zone.dynamic_count;
    // Bodies that have not turned and carry no torque need no change of chart.
    for (int i = 0; i < count; ++i) {
        const ZoneBody& body = zone.bodies[i];
        const Vec6& y = point.y.bodies[i];
        const Vec6 error = y - body.target;
        Vec6& gradient = derivatives.gradient.bodies[i];
        derivatives.torque[i] = gradient.head<3>();
        const bool turned = !y.head<3>().isZero(0.0);
        Mat3& J = derivatives.jacobian[i];
        J.setIdentity();
        if (turned) {
            J = left_jacobian(y.head<3>());
            gradient.head<3>() = J.transpose() * derivatives.torque[i];
            if (system != nullptr) {
                Mat6& block = system->diagonal(i);
                block.topRows<3>() = J.transpose() * block.topRows<3>().eval();
                block.leftCols<3>() = block.leftCols<3>().eval() * J;
            }
        }
        gradient.head<3>() += body.inertia * error.head<3>();
        gradient.tail<3>() += body.mass * error.tail<3>();
        if (system == nullptr) continue;
        Mat6& block = system->diagonal(i);
        if (turned && curvature != Curvature::dropped && !derivatives.torque[i].isZero(0.0)) {
            Mat3 extra = chart_curvature(y, derivatives.torque[i]);
            cut_negative_part<3>(cut, extra);
            block.topLeftCorner<3, 3>() += extra;
        }
        block.topLeftCorner<3, 3>() += body.inertia;
        block.diagonal().tail<3>().array() += body.mass;
    }
    if (!zone.nodes.empty()) add_cloth(zone, point, cut, derivatives, system);
    if (system == nullptr) return;
    const BlockPattern& pattern = system->pattern();
    for (int k = 0; k < static_cast<int>(pattern.body_pairs.size()); ++k) {
        const auto [i, j] = pattern.body_pairs[k];
        Mat6& block = system->off_diagonal(k);
        block.topRows<3>() = derivatives.jacobian[i].transpose() * block.topRows<3>().eval();
        block.leftCols<3>() = block.leftCols<3>().eval() * derivatives.jacobian[j];
    }
    for (int k = 0; k < static_cast<int>(pattern.mixed_pairs.size()); ++k) {
        Mat63& block = system->mixed_pair(k);
        block.topRows<3>() = derivatives.jacobian[pattern.mixed_pairs[k].first].transpose() * block.topRows<3>().eval();
    }
}

}  // namespace

void differentiate(
    const Zone& zone, const ZonePoint& point, Curvature curvature, ZoneDerivatives& derivatives, BlockSystem* system,
    CutShare cut) {
    set_zero(zone, derivatives);
    if (curvature == Curvature::none) system = nullptr;
    if (system != nullptr) {
        if (!zone.nodes.empty()) {
            std::vector<int> indices;
            for (const ActiveContact& active : point.active) indices.push_back(active.index);
            ensure_pattern(zone, indices, *system);
        }
        system->set_zero();
    }
    add_contact_derivatives(zone, point, curvature, cut, derivatives, system);
    end_differentiation(zone, point, curvature, derivatives, system, cut);
}

void differentiate_smooth(
    const Zone& zone, const ZonePoint& point, const std::vector<PushingContact>& pushing, CutShare cut,
    ZoneDerivatives& derivatives, BlockSystem& system) {
    set_zero(zone, derivatives);
    system.set_zero();
    add_contact_curvature(zone, point, pushing, cut, derivatives, system);
    end_differentiation(zone, point, Curvature::full, derivatives, &system, cut);
}

}  // namespace diffsim
