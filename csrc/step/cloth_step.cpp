#include "step/cloth_step.hpp"

#include <utility>

#include "dynamics/two_stages.hpp"

namespace diffsim {
namespace {

/// Velocity at the end of a step of a node of this mass that nothing touches, not even its neighbours.
Vec3 free_node_velocity(const Vec3& velocity, const Vec3& force, double mass, const Parameters& parameters, double dt) {
    return velocity + dt * (parameters.gravity + force / mass);
}

/// How far a node goes in two stages, of which the second has dt times this velocity.
Vec3 place_by_velocity(const StepSetting& setting, int node, const SceneState& state, const Vec3& dt_velocity) {
    return kFirstStageShare * ((*setting.first_stage)[node] - state.node_position[node]) + kStage * dt_velocity;
}

/// How the step strains a cloth.
Straining straining_of(const StepSetting& setting, const Cloth& cloth, const SceneState& state, const Vec3& origin) {
    const double dt = setting.dt;
    Straining result;
    result.start = elastic_start(cloth, state.node_position.data() + cloth.first_node);
    result.scale = dt * dt;
    result.time = dt;
    if (!setting.after_first_stage()) return result;
    const Vec3* first_stage = setting.first_stage->data() + cloth.first_node;
    for (int k = 0; k < cloth.node_count(); ++k) result.first_stage.push_back(first_stage[k] - origin);
    result.time = kStage * dt;
    result.start_share = kFirstStageShare;
    result.start = extrapolated(result.start, elastic_start(cloth, first_stage), kFirstStageShare);
    if (setting.part == StepPart::velocities) {
        result.share = kStage;
        result.base_share = kFirstStageShare;
    } else {
        result.scale = kStage * dt * dt;
    }
    return result;
}

/// The elastic and damping forces at the end of the first stage, turned round [N].
std::vector<Vec3> first_stage_forces(const StepSetting& setting, const Cloth& cloth, int id, const SceneState& state) {
    std::vector<Vec3> forces(static_cast<std::size_t>(cloth.node_count()), Vec3::Zero());
    add_elastic_gradient(
        cloth, setting.parameters.cloths[id], kStage * setting.dt,
        elastic_start(cloth, state.node_position.data() + cloth.first_node),
        setting.first_stage->data() + cloth.first_node, 1.0, forces.data());
    return forces;
}

}  // namespace

void add_cloth(Zone& zone, int id, const StepSetting& setting, const SceneState& state, const SceneControl& control) {
    const Cloth& cloth = setting.model.cloths[id];
    const double dt = setting.dt;
    ZoneCloth entry;
    entry.id = id;
    entry.first_node = zone.node_count();
    entry.straining = straining_of(setting, cloth, state, zone.origin);
    zone.cloths.push_back(std::move(entry));
    const bool two_stages = setting.after_first_stage();
    const std::vector<Vec3> forces = two_stages ? first_stage_forces(setting, cloth, id, state) : std::vector<Vec3>();
    for (int k = 0; k < cloth.node_count(); ++k) {
        const int i = cloth.first_node + k;
        ZoneNode node;
        node.start = state.node_position[i] - zone.origin;
        node.weight = setting.node_weight();
        const double mass = setting.parameters.cloths[id].density * cloth.node_area[k];
        node.mass = node.weight * mass;
        node.pinned = cloth.pinned[k] != 0;
        node.last_motion = dt * state.node_velocity[i];
        if (node.pinned) {
            node.target = dt * control.node_velocity[i];
        } else {
            node.target =
                dt * free_node_velocity(state.node_velocity[i], control.node_force[i], mass, setting.parameters, dt);
            if (two_stages) node.target -= (1.0 - kStage) * dt * dt / mass * forces[static_cast<std::size_t>(k)];
            if (setting.part == StepPart::places && two_stages) {
                node.target = place_by_velocity(setting, i, state, node.target);
                if (setting.end_velocity != nullptr && !setting.end_velocity->empty())
                    node.guess = place_by_velocity(setting, i, state, dt * (*setting.end_velocity)[i]);
            }
        }
        zone.nodes.push_back(node);
    }
}

void end_cloth(
    const StepSetting& setting, int id, const SceneControl& control, const std::vector<Vec3>& shift, bool as_told,
    SceneState& state) {
    const Cloth& cloth = setting.model.cloths[id];
    for (int k = 0; k < cloth.node_count(); ++k) {
        const int node = cloth.first_node + k;
        state.node_position[node] += shift[node];
        state.node_velocity[node] =
            cloth.pinned[k] && as_told ? control.node_velocity[node] : Vec3(shift[node] / setting.dt);
    }
}

Box space_of_cloth(const StepSetting& setting, int id, const SceneState& state, const SceneControl& control) {
    const Cloth& cloth = setting.model.cloths[id];
    const double dt = setting.dt;
    Box box;
    for (int k = 0; k < cloth.node_count(); ++k) {
        const int node = cloth.first_node + k;
        const Vec3 &x = state.node_position[node], &v = state.node_velocity[node];
        box.include(x);
        if (cloth.pinned[k]) {
            box.include(x + dt * control.node_velocity[node]);
            continue;
        }
        box.include(x + dt * v);
        box.include(x + dt * (v + dt * setting.parameters.gravity));
    }
    box.inflate(cloth.margin + 0.5 * setting.model.own_thickness(setting.model.body_count() + id));
    return box;
}

bool cloth_overflows(const StepSetting& setting, int id, const SceneState& state, const SceneControl& control) {
    const Cloth& cloth = setting.model.cloths[id];
    const Parameters& parameters = setting.parameters;
    for (int k = 0; k < cloth.node_count(); ++k) {
        const int i = cloth.first_node + k;
        const double mass = parameters.cloths[id].density * cloth.node_area[k];
        const Vec3& velocity = state.node_velocity[i];
        const Vec3 driven = cloth.pinned[k] != 0
                                ? control.node_velocity[i]
                                : free_node_velocity(velocity, control.node_force[i], mass, parameters, setting.dt);
        if (!(state.node_position[i].squaredNorm() + velocity.squaredNorm() + driven.squaredNorm() <= kLargestSquare))
            return true;
    }
    return false;
}

// --- backward --------------------------------------------------------------------------------------------------------

Vec3 node_upstream(const SceneStateGradient& end, int node, double dt) {
    return end.node_position[node] + end.node_velocity[node] / dt;
}

void ClothBackward::finish(const Zone& zone, const ZoneAdjoint& adjoint) {
    for (std::size_t c = 0; c < zone.cloths.size(); ++c) {
        const ZoneCloth& cloth = zone.cloths[c];
        const Cloth& model = m_setting.model.cloths[cloth.id];
        for (int k = 0; k < model.node_count(); ++k) {
            const int node = cloth.first_node + k;
            const Vec3& pose = adjoint.pose_gradient.nodes[node];
            if (zone.nodes[node].pinned) {
                // Their motion is given, but contacts with their features are as stiff as their mass makes them.
                m_parameter_gradient.cloths[cloth.id].density += adjoint.node_mass_gradient[node] * model.node_area[k];
                pinned_node(
                    model.first_node + k, pose, adjoint.start_gradient[node], adjoint.drive_gradient.nodes[node]);
                continue;
            }
            const Vec3 error = zone.nodes[node].weight * (m_y.nodes[model.first_node + k] - zone.nodes[node].target);
            free_node(
                cloth.id, k, adjoint.multiplier.nodes[node], error, adjoint.node_mass_gradient[node],
                pose + adjoint.start_gradient[node]);
        }
        add_material(cloth.id, adjoint.cloth_gradient[c]);
        if (m_setting.after_first_stage()) add_first_stage(zone, adjoint, cloth);
    }
}

/// The zone of one cloth's elastic pass, at its solution, and the gradient there: of its motion
/// as the contact pass's target.
void ClothBackward::start_elastic_pass(
    const Zone& contact_zone, const ZoneAdjoint& contact, const ZoneCloth& cloth,
    const std::vector<Vec3>& elastic_shift, Zone& zone, ZonePoint& point, Coordinates& upstream) {
    const Cloth& model = m_setting.model.cloths[cloth.id];
    make_zone(zone, m_setting.model, m_setting.parameters.cloths, kDefaultCompliance, contact_zone.origin);
    zone.contacts_off = true;
    add_cloth(zone, cloth.id, m_setting, m_start, m_control);
    for (int k = 0; k < model.node_count(); ++k) {
        const int node = cloth.first_node + k, id = model.first_node + k;
        const Vec3& z = contact.multiplier.nodes[node];
        upstream.nodes.push_back(contact_zone.nodes[node].mass * z);
        point.y.nodes.push_back(elastic_shift[id]);
        // of the mass in  m (u - target)
        const Vec3 error = m_y.nodes[id] - elastic_shift[id];
        const double mass_gradient = contact.node_mass_gradient[node] - z.dot(error);
        m_parameter_gradient.cloths[cloth.id].density += mass_gradient * model.node_area[k];
    }
    evaluate(zone, point);
}

void ClothBackward::finish_split(
    const Zone& contact_zone, const ZoneAdjoint& contact, const std::vector<Vec3>& elastic_shift, AdjointMode mode,
    const GradientNeeds& needs, AdjointWorkspace& workspace) {
    for (const ZoneCloth& cloth : contact_zone.cloths) {
        const Cloth& model = m_setting.model.cloths[cloth.id];
        Zone zone;
        ZonePoint point;
        Coordinates upstream;
        start_elastic_pass(contact_zone, contact, cloth, elastic_shift, zone, point, upstream);
        ZoneAdjoint adjoint = zone_adjoint(zone, point, {}, upstream, mode, needs, workspace);
        for (int k = 0; k < model.node_count(); ++k) {
            const int id = model.first_node + k;
            Vec3& pose = adjoint.pose_gradient.nodes[k];
            pose += contact.pose_gradient.nodes[cloth.first_node + k];
            if (zone.nodes[k].pinned) {
                pinned_node(id, pose, adjoint.start_gradient[k], contact.drive_gradient.nodes[cloth.first_node + k]);
                continue;
            }
            const Vec3 error = elastic_shift[id] - zone.nodes[k].target;
            free_node(cloth.id, k, adjoint.multiplier.nodes[k], error, 0.0, pose + adjoint.start_gradient[k]);
        }
        add_material(cloth.id, adjoint.cloth_gradient[0]);
    }
}

void ClothBackward::add_material(int cloth, const ClothParameters& gradient) {
    ClothParameters& sum = m_parameter_gradient.cloths[cloth];
    sum.stretch += gradient.stretch;
    sum.shear += gradient.shear;
    sum.bend += gradient.bend;
    sum.damping += gradient.damping;
}

/// What reaches the first stage: through strains, through the forces at its end, which targets have a part of, and
/// through how far it went.
void ClothBackward::add_first_stage(const Zone& zone, const ZoneAdjoint& adjoint, const ZoneCloth& cloth) {
    const Cloth& model = m_setting.model.cloths[cloth.id];
    const ClothParameters& parameters = m_setting.parameters.cloths[cloth.id];
    const std::size_t first = static_cast<std::size_t>(cloth.first_node);
    const double dt = m_setting.dt, scale = -(1.0 - kStage) * dt * dt;
    const Vec3 *x0 = m_start.node_position.data() + model.first_node,
               *x1 = m_setting.first_stage->data() + model.first_node, *z = adjoint.multiplier.nodes.data() + first;
    Vec3* of_x0 = m_gradient.node_position.data() + model.first_node;
    Vec3* of_x1 = m_first_stage_gradient->data() + model.first_node;
    const ElasticStart start = elastic_start(model, x0);
    const std::vector<Vec3> forces = first_stage_forces(m_setting, model, cloth.id, m_start);
    for (int k = 0; k < model.node_count(); ++k) {
        of_x1[k] += adjoint.first_stage_gradient[first + static_cast<std::size_t>(k)];
        const ZoneNode& node = zone.nodes[first + static_cast<std::size_t>(k)];
        if (node.pinned) continue;
        const double mass = node.mass / node.weight;
        m_parameter_gradient.cloths[cloth.id].density -=
            scale / mass * forces[static_cast<std::size_t>(k)].dot(z[k]) * model.node_area[k];
        if (m_setting.part != StepPart::places) continue;
        const Vec3 way = kFirstStageShare * node.mass * z[k];
        of_x1[k] += way;
        of_x0[k] -= way;
    }
    add_elastic_hessian_product(model, parameters, kStage * dt, start, x1, z, scale, of_x1);
    add_material(cloth.id, add_elastic_backward(model, parameters, kStage * dt, start, x1, x0, z, scale, of_x0));
}

/// A free node with multiplier z of m (u - target) + ... = 0, target = dt (v0 + dt (g + f / m)).
void ClothBackward::free_node(
    int cloth, int k, const Vec3& z, const Vec3& error, double mass_gradient, const Vec3& pose) {
    const Cloth& model = m_setting.model.cloths[cloth];
    const int node = model.first_node + k;
    const double dt = m_setting.dt;
    const double mass = m_setting.parameters.cloths[cloth].density * model.node_area[k];
    const Vec3 grad_velocity = dt * mass * z;  // of the velocity at the end of free motion
    const Vec3& force = m_control.node_force[node];
    mass_gradient -= z.dot(error) + dt / (mass * mass) * force.dot(grad_velocity);
    m_parameter_gradient.cloths[cloth].density += mass_gradient * model.node_area[k];
    m_control_gradient.node_force[node] += dt / mass * grad_velocity;
    m_gradient.node_position[node] += pose;
    m_gradient.node_velocity[node] = grad_velocity;
}

/// A pinned node, whose motion is dt times its given velocity; `start` is the gradient with respect to where it starts
/// while it ends where it did, `drive` to how it gets there, through slips.
void ClothBackward::pinned_node(int node, const Vec3& pose, const Vec3& start, const Vec3& drive) {
    const Vec3 position = m_gradient.node_position[node] + pose;
    m_control_gradient.node_velocity[node] += m_gradient.node_velocity[node] + m_setting.dt * (position + drive);
    m_gradient.node_position[node] = position + start;
    m_gradient.node_velocity[node].setZero();
}

}  // namespace diffsim
