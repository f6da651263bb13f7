#include "step.hpp"

#include <Eigen/Geometry>
#include <Eigen/LU>
#include <algorithm>
#include <chrono>
#include <numeric>
#include <stdexcept>

#include "contact/adjoint.hpp"
#include "contact/separation.hpp"
#include "math/rotation.hpp"

namespace diffsim {
namespace {

constexpr int kMaxMerges = 50;   // each merge joins at least two zones
constexpr int kMaxBlocked = 8;  // shortenings of a blocked drive before it is stopped

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point& last) {
    const Clock::time_point now = Clock::now();
    const double seconds = std::chrono::duration<double>(now - last).count();
    last = now;
    return seconds;
}

/// Disjoint sets; the root of a set is its smallest member, so that numbering does not depend on the order of unions.
class UnionFind {
public:
    explicit UnionFind(int count) : m_parent(static_cast<std::size_t>(count)) {
        std::iota(m_parent.begin(), m_parent.end(), 0);
    }
    int find(int i) {
        while (m_parent[i] != i) i = m_parent[i] = m_parent[m_parent[i]];
        return i;
    }
    void unite(int i, int j) {
        i = find(i);
        j = find(j);
        m_parent[std::max(i, j)] = std::min(i, j);
    }

private:
    std::vector<int> m_parent;
};

std::uint64_t mix(std::uint64_t hash, std::uint64_t value) {
    hash ^= value + 0x9e3779b97f4a7c15ull + (hash << 6) + (hash >> 2);
    return hash * 0xff51afd7ed558ccdull;
}

/// A dynamic body at step start, in the world frame, with its motion if nothing touches it.
ZoneBody prepare_body(int id, const BodyState& state, const Parameters& parameters, const FreeRotation& rotation,
                      const Vec3& free_velocity, double dt) {
    ZoneBody body;
    body.id = id;
    body.start = {quaternion_to_matrix(state.orientation), state.position};
    body.inertia = body.start.R * parameters.inertia[id] * body.start.R.transpose();
    body.mass = parameters.mass[id];
    body.target << rotation.rotation, dt * free_velocity;
    body.warm << dt * state.angular_velocity, dt * state.velocity;
    return body;
}

Vec3 free_velocity(const BodyState& state, const BodyControl& control, const Parameters& parameters, int id, double dt) {
    return state.velocity + dt * (parameters.gravity + control.force / parameters.mass[id]);
}

/// Everything about one step that its parts share.
class Stepper {
public:
    Stepper(const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
            const SceneControl& control, StepWorkspace& workspace, StepInfo& info)
        : m_model(model),
          m_options(options),
          m_parameters(parameters),
          m_state(state),
          m_control(control),
          m_workspace(workspace),
          m_info(info) {}

    SceneState run(StepRecord* record) {
        m_info = StepInfo{};
        Clock::time_point clock = Clock::now();
        predict();
        m_info.seconds_motion = seconds_since(clock);
        for (int attempt = 0;; ++attempt) {
            list_passive();
            group();
            m_info.seconds_broad_phase += seconds_since(clock);
            m_blocked.clear();
            solve_all();
            for (int merge = 0; merge < kMaxMerges && merge_met_zones(); ++merge) solve_all();
            m_info.seconds_zones += seconds_since(clock);
            if (m_blocked.empty()) break;
            shorten_drives(attempt >= kMaxBlocked);
        }
        const SceneState result = finish();
        if (record != nullptr) write(*record);
        m_info.seconds_motion += seconds_since(clock);
        return result;
    }

private:
    struct ZoneOutcome {
        int root = 0;                  ///< smallest body
        std::vector<int> bodies;       ///< dynamic
        std::vector<Contact> contacts;  ///< active
        ZoneResult result;
        double max_compression = 0.0;
        std::uint64_t signature = 0;
        bool free = false;  ///< nothing near
    };

    // --- motion without contact --------------------------------------------------------------------------------

    void predict() {
        const int count = m_model.body_count();
        const double dt = m_options.dt;
        m_rotation.assign(static_cast<std::size_t>(count), FreeRotation{Vec3::Zero(), Vec3::Zero(), 1});
        m_velocity.assign(static_cast<std::size_t>(count), Vec3::Zero());
        m_y.assign(static_cast<std::size_t>(count), Vec6::Zero());
        m_bodies.resize(static_cast<std::size_t>(count));
        for (int i = 0; i < count; ++i) {
            const BodyState& state = m_state[i];
            const BodyControl& control = m_control[i];
            if (m_model.bodies[i].kind == BodyKind::kinematic) {
                m_y[i] << dt * control.angular_velocity, dt * control.velocity;
                continue;
            }
            if (m_model.bodies[i].kind == BodyKind::static_) continue;
            const Mat3 R = quaternion_to_matrix(state.orientation);
            m_rotation[i] =
                free_rotation(R, state.angular_velocity, control.torque, m_parameters.inertia[i], dt);
            m_velocity[i] = free_velocity(state, control, m_parameters, i, dt);
            m_bodies[i] = prepare_body(i, state, m_parameters, m_rotation[i], m_velocity[i], dt);
            m_y[i] = m_bodies[i].target;
        }
    }

    // --- who may meet whom -------------------------------------------------------------------------------------

    void list_passive() {
        m_passive.bodies.clear();
        std::vector<Box> boxes;
        for (int i = 0; i < m_model.body_count(); ++i) {
            const Body& body = m_model.bodies[i];
            if (body.is_dynamic()) continue;
            PassiveBody passive{i, {quaternion_to_matrix(m_state[i].orientation), m_state[i].position}, m_y[i]};
            ZoneBody moved;
            moved.start = passive.start;
            const double angle = passive.target.head<3>().norm();
            const double arc = body.mesh.radius * std::min(0.125 * angle * angle, 2.0);
            boxes.push_back(swept_box(
                {&body.mesh, {passive.start, pose_at(moved, passive.target)}, body.margin + arc}));
            m_passive.bodies.push_back(passive);
        }
        m_passive.tree = build_box_tree(boxes);
    }

    void group() {
        const int count = m_model.body_count();
        std::vector<Box>& boxes = m_workspace.boxes;
        boxes.clear();
        m_box_bodies.clear();
        for (int i = 0; i < count; ++i) {
            if (!m_model.bodies[i].is_dynamic()) continue;
            const Body& body = m_model.bodies[i];
            const ZoneBody& moving = m_bodies[i];
            const double angle = std::max(moving.target.head<3>().norm(), moving.warm.head<3>().norm());
            const double arc = body.mesh.radius * std::min(0.125 * angle * angle, 2.0);
            const double reach = body.margin + 0.5 * m_model.thickness + arc;
            Box box = swept_box({&body.mesh, {moving.start, pose_at(moving, moving.target)}, reach});
            box.include(swept_box({&body.mesh, {moving.start, pose_at(moving, moving.warm)}, reach}));
            boxes.push_back(box);
            m_box_bodies.push_back(i);
        }
        m_groups = UnionFind(count);
        for (const auto& [a, b] : overlapping_pairs(build_box_tree(boxes)))
            m_groups.unite(m_box_bodies[a], m_box_bodies[b]);
        m_dirty.assign(static_cast<std::size_t>(count), 1);
        m_outcomes.assign(static_cast<std::size_t>(count), ZoneOutcome{});
        m_visited.assign(static_cast<std::size_t>(count), Box());
        m_swept.assign(static_cast<std::size_t>(count), Box());
        for (std::size_t k = 0; k < boxes.size(); ++k) m_swept[m_box_bodies[k]] = boxes[k];
    }

    bool meets_ground(int body) const {
        return m_model.ground.present && m_swept[body].lower.z() <= m_model.ground.height + m_model.ground.margin;
    }

    bool meets_passive(int body) const {
        if (m_passive.bodies.empty()) return false;
        std::vector<int> near;
        query(m_passive.tree, m_swept[body], near);
        return !near.empty();
    }

    // --- zones -------------------------------------------------------------------------------------------------

    /// Solve the groups marked dirty.
    void solve_all() {
        std::vector<std::vector<int>> members(m_model.bodies.size());
        for (int i : m_box_bodies) members[m_groups.find(i)].push_back(i);
        for (int root : m_box_bodies) {
            if (members[root].empty() || !m_dirty[root]) continue;
            m_dirty[root] = 0;
            solve_group(root, members[root]);
        }
    }

    void solve_group(int root, const std::vector<int>& members) {
        ZoneOutcome& outcome = m_outcomes[root];
        outcome = ZoneOutcome{};
        outcome.root = root;
        outcome.bodies = members;
        if (members.size() == 1 && !meets_ground(root) && !meets_passive(root)) {
            outcome.free = true;
            m_y[root] = m_bodies[root].target;
            m_visited[root] = m_swept[root];
            return;
        }
        Zone& zone = m_zone;
        zone.model = &m_model;
        zone.compliance = m_options.compliance;
        zone.origin = m_bodies[root].start.t;
        zone.ground_height = m_model.ground.height - zone.origin.z();
        zone.bodies.clear();
        for (int i : members) {
            zone.bodies.push_back(m_bodies[i]);
            zone.bodies.back().inverse_inertia = m_bodies[i].inertia.inverse();
            zone.bodies.back().start.t -= zone.origin;
        }
        zone.dynamic_count = static_cast<int>(members.size());
        const ZoneOptions options{m_options.tolerance, m_options.max_iterations};
        outcome.result = solve_zone(zone, m_passive, options, m_workspace.zone, m_workspace.visited);
        const ZonePoint& point = m_workspace.zone.point;
        if (outcome.result.status == ZoneStatus::bad_start)
            refuse_start(zone.contacts[outcome.result.worst_contact], point.distances[outcome.result.worst_contact]);
        for (std::size_t k = 0; k < members.size(); ++k) {
            const int i = members[k];
            m_y[i] = point.y[k];
            Box box = m_workspace.visited[k];
            box.inflate(m_model.bodies[i].margin);
            box.lower += zone.origin;
            box.upper += zone.origin;
            m_visited[i] = box;
        }
        for (const ActiveContact& active : point.active) {
            const ZoneContact& contact = zone.contacts[active.index];
            const Contact& c = contact.contact;
            outcome.contacts.push_back(c);
            outcome.max_compression = std::max(outcome.max_compression, contact.range.rest - active.geometry.distance);
            outcome.signature = mix(outcome.signature, (static_cast<std::uint64_t>(c.object_a) << 32) ^
                                                           static_cast<std::uint32_t>(c.object_b));
            outcome.signature = mix(outcome.signature, (static_cast<std::uint64_t>(c.feature_a) << 32) ^
                                                           static_cast<std::uint32_t>(c.feature_b));
            outcome.signature = mix(outcome.signature, (static_cast<std::uint64_t>(c.type) << 32) ^
                                                           active.geometry.closest.feature_code);
        }
        if (outcome.result.status != ZoneStatus::blocked) return;
        for (int k = zone.dynamic_count; k < zone.body_count(); ++k)
            if (point.y[k] != zone.bodies[k].target) m_blocked.emplace_back(zone.bodies[k].id, point.y[k]);
    }

    [[noreturn]] void refuse_start(const ZoneContact& contact, double distance) const {
        throw std::invalid_argument(
            "state: '" + m_model.name(contact.contact.object_a) + "' and '" + m_model.name(contact.contact.object_b) +
            "' are " + std::to_string(distance) + " m apart, nearer than the " + std::to_string(contact.range.pole) +
            " m that no contact can keep; move them apart, for instance with sim.separate(state)");
    }

    /// Bodies that were pushed out of the space reserved for them may have met others: join such groups.
    bool merge_met_zones() {
        bool left = false;
        for (int i : m_box_bodies) {
            const Box &inner = m_visited[i], &outer = m_swept[i];
            left = left || (inner.lower.array() < outer.lower.array()).any() ||
                   (inner.upper.array() > outer.upper.array()).any();
        }
        if (!left) return false;
        std::vector<Box> boxes;
        for (int i : m_box_bodies) {
            m_swept[i].include(m_visited[i]);
            boxes.push_back(m_swept[i]);
        }
        bool merged = false;
        for (const auto& [a, b] : overlapping_pairs(build_box_tree(boxes))) {
            const int i = m_groups.find(m_box_bodies[a]), j = m_groups.find(m_box_bodies[b]);
            if (i == j) continue;
            m_groups.unite(i, j);
            m_outcomes[i] = m_outcomes[j] = ZoneOutcome{};
            m_dirty[std::min(i, j)] = 1;
            merged = true;
        }
        // A free body has its own box as visited space: one that now meets others was marked above.
        return merged;
    }

    /// What drives could not do for one zone they must not do for any.
    void shorten_drives(bool stop) {
        m_info.converged = false;
        m_info.status = ZoneStatus::blocked;
        for (const auto& [body, reached] : m_blocked) {
            if (stop || reached.squaredNorm() < m_y[body].squaredNorm()) m_y[body] = stop ? Vec6(Vec6::Zero()) : reached;
        }
    }

    // --- results -----------------------------------------------------------------------------------------------

    SceneState finish() {
        const double dt = m_options.dt;
        SceneState result = m_state;
        for (int i = 0; i < m_model.body_count(); ++i) {
            const BodyKind kind = m_model.bodies[i].kind;
            BodyState& body = result[i];
            if (kind == BodyKind::static_) continue;
            const Vec3 turn = m_y[i].head<3>(), shift = m_y[i].tail<3>();
            if (!turn.isZero(0.0)) {
                body.orientation = quaternion_multiply(exp_quaternion(turn), body.orientation);
                body.orientation /= body.orientation.norm();
            }
            body.position += shift;
            if (kind == BodyKind::kinematic) {
                body.angular_velocity = m_control[i].angular_velocity;
                body.velocity = m_control[i].velocity;
                if (!m_info.converged) {
                    body.angular_velocity = turn / dt;
                    body.velocity = shift / dt;
                }
                continue;
            }
            // w1 = turn / dt and v1 = shift / dt, written so that free bodies keep what free motion gave them exactly.
            body.angular_velocity = m_rotation[i].angular_velocity + (turn - m_rotation[i].rotation) / dt;
            body.velocity = m_velocity[i] + (shift - m_bodies[i].target.tail<3>()) / dt;
        }
        for (int root : m_box_bodies) {
            const ZoneOutcome& outcome = m_outcomes[root];
            if (outcome.bodies.empty() || outcome.free) continue;
            if (outcome.result.status != ZoneStatus::converged) {
                m_info.converged = false;
                if (m_info.status == ZoneStatus::converged) m_info.status = outcome.result.status;
            }
            m_info.iterations = std::max(m_info.iterations, outcome.result.iterations);
            m_info.residual = std::max(m_info.residual, outcome.result.residual);
            m_info.max_compression = std::max(m_info.max_compression, outcome.max_compression);
            m_info.contacts += static_cast<int>(outcome.contacts.size());
            m_info.signature = mix(m_info.signature, outcome.signature);
        }
        split_zones();
        return result;
    }

    /// Groups of bodies that really touch: what the backward solves together.
    void split_zones() {
        m_zone_list.clear();
        UnionFind sets(m_model.body_count());
        std::vector<char> touched(m_model.bodies.size(), 0);
        const auto is_dynamic = [&](int object) { return object >= 0 && m_model.bodies[object].is_dynamic(); };
        for (int root : m_box_bodies) {
            for (const Contact& c : m_outcomes[root].contacts) {
                const bool a = is_dynamic(c.object_a), b = is_dynamic(c.object_b);
                if (a) touched[c.object_a] = 1;
                if (b) touched[c.object_b] = 1;
                if (a && b) sets.unite(c.object_a, c.object_b);
            }
        }
        std::vector<int> zone_of(m_model.bodies.size(), -1);
        for (int i : m_box_bodies) {
            if (!touched[i]) continue;
            const int root = sets.find(i);
            if (zone_of[root] < 0) {
                zone_of[root] = static_cast<int>(m_zone_list.size());
                m_zone_list.emplace_back();
            }
            m_zone_list[zone_of[root]].bodies.push_back(i);
        }
        for (int root : m_box_bodies)
            for (const Contact& c : m_outcomes[root].contacts) {
                const int body = is_dynamic(c.object_a) ? c.object_a : c.object_b;
                m_zone_list[zone_of[sets.find(body)]].contacts.push_back(c);
            }
        m_info.zones = static_cast<int>(m_zone_list.size());
        for (const TouchingZone& zone : m_zone_list)
            m_info.largest_zone = std::max(m_info.largest_zone, static_cast<int>(zone.bodies.size()));
    }

    void write(StepRecord& record) const {
        record.start = m_state;
        record.free_rotation = m_rotation;
        record.y = m_y;
        record.zone_bodies.clear();
        record.zone_body_end.clear();
        record.zone_contact_end.clear();
        record.contacts.clear();
        for (const TouchingZone& zone : m_zone_list) {
            record.zone_bodies.insert(record.zone_bodies.end(), zone.bodies.begin(), zone.bodies.end());
            record.contacts.insert(record.contacts.end(), zone.contacts.begin(), zone.contacts.end());
            record.zone_body_end.push_back(static_cast<int>(record.zone_bodies.size()));
            record.zone_contact_end.push_back(static_cast<int>(record.contacts.size()));
        }
    }

    struct TouchingZone {
        std::vector<int> bodies;
        std::vector<Contact> contacts;
    };

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneState& m_state;
    const SceneControl& m_control;
    StepWorkspace& m_workspace;
    StepInfo& m_info;

    std::vector<FreeRotation> m_rotation;  // one per body, as all below unless said otherwise
    std::vector<Vec3> m_velocity;
    Coordinates m_y;
    std::vector<ZoneBody> m_bodies;
    PassiveBodies m_passive;
    std::vector<int> m_box_bodies;  // the dynamic bodies
    UnionFind m_groups{0};
    std::vector<char> m_dirty;
    std::vector<ZoneOutcome> m_outcomes;  // at the root of each group
    std::vector<Box> m_swept, m_visited;  // world frame, margins included
    std::vector<std::pair<int, Vec6>> m_blocked;  // kinematic bodies that did not reach their targets, and where they are
    std::vector<TouchingZone> m_zone_list;
    Zone m_zone;
};

// --- backward ------------------------------------------------------------------------------------------------------

/// The backward of one step, body by body and zone by zone.
class StepBackward {
public:
    StepBackward(const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
                 const StepRecord& record, StepWorkspace& workspace, std::vector<BodyStateGradient>& gradient,
                 std::vector<BodyControlGradient>& control_gradient, ParameterGradient& parameter_gradient)
        : m_model(model),
          m_options(options),
          m_parameters(parameters),
          m_control(control),
          m_record(record),
          m_workspace(workspace),
          m_gradient(gradient),
          m_control_gradient(control_gradient),
          m_parameter_gradient(parameter_gradient) {}

    void run() {
        const std::size_t count = m_model.bodies.size();
        m_pose_gradient.assign(count, Vec6::Zero());
        m_multiplier.assign(count, Vec6::Zero());
        std::vector<char> in_zone(count, 0);
        int first_body = 0, first_contact = 0;
        for (std::size_t k = 0; k < m_record.zone_body_end.size(); ++k) {
            for (int b = first_body; b < m_record.zone_body_end[k]; ++b) in_zone[m_record.zone_bodies[b]] = 1;
            solve_zone_adjoint(first_body, m_record.zone_body_end[k], first_contact, m_record.zone_contact_end[k]);
            first_body = m_record.zone_body_end[k];
            first_contact = m_record.zone_contact_end[k];
        }
        for (int i = 0; i < static_cast<int>(count); ++i) {
            switch (m_model.bodies[i].kind) {
                case BodyKind::dynamic:
                    dynamic_body(i, in_zone[i] != 0);
                    break;
                case BodyKind::kinematic:
                    kinematic_body(i);
                    break;
                case BodyKind::static_:
                    static_body(i);
                    break;
            }
        }
    }

private:
    /// d(loss)/dy of a body through its state at the end of the step.
    Vec6 upstream(int i) const {
        const BodyStateGradient& g = m_gradient[i];
        const double dt = m_options.dt;
        Vec6 v;
        v << left_jacobian(m_record.y[i].head<3>()).transpose() * g.orientation + g.angular_velocity / dt,
            g.position + g.velocity / dt;
        return v;
    }

    void solve_zone_adjoint(int first_body, int body_end, int first_contact, int contact_end) {
        Zone& zone = m_zone;
        zone.model = &m_model;
        zone.compliance = m_options.compliance;
        zone.bodies.clear();
        zone.contacts.clear();
        zone.pairs.clear();
        zone.origin = m_record.start[m_record.zone_bodies[first_body]].position;
        zone.ground_height = m_model.ground.height - zone.origin.z();
        ZonePoint& point = m_workspace.zone.point;
        point.y.clear();
        std::vector<std::pair<int, int>> local;  // body id, index in the zone; few enough to search
        const auto add_body = [&](int id) {
            const BodyState& state = m_record.start[id];
            const bool dynamic = m_model.bodies[id].is_dynamic();
            ZoneBody body;
            body.id = id;
            body.start = {quaternion_to_matrix(state.orientation), state.position - zone.origin};
            body.mass = dynamic ? m_parameters.mass[id] : kInfinity;
            body.target = m_record.y[id];
            if (dynamic) {
                body.inertia = body.start.R * m_parameters.inertia[id] * body.start.R.transpose();
                body.inverse_inertia = body.inertia.inverse();
                body.target << m_record.free_rotation[id].rotation,
                    m_options.dt * free_velocity(state, m_control[id], m_parameters, id, m_options.dt);
            }
            m_local[id] = static_cast<int>(zone.bodies.size());
            zone.bodies.push_back(body);
            point.y.push_back(m_record.y[id]);
        };
        m_local.resize(m_model.bodies.size(), -1);
        for (int b = first_body; b < body_end; ++b) add_body(m_record.zone_bodies[b]);
        zone.dynamic_count = body_end - first_body;
        for (int c = first_contact; c < contact_end; ++c) {
            const Contact& contact = m_record.contacts[c];
            for (int object : {contact.object_a, contact.object_b})
                if (object >= 0 && m_local[object] < 0) add_body(object);
        }
        for (int c = first_contact; c < contact_end; ++c) {
            const Contact& contact = m_record.contacts[c];
            const int a = m_local[contact.object_a];
            const int b = contact.with_ground() ? kGround : m_local[contact.object_b];
            const double mass_b = b == kGround ? kInfinity : zone.bodies[b].mass;
            ZoneContact entry;
            entry.contact = contact;
            entry.a = a;
            entry.b = b;
            entry.pair = -1;
            entry.range = contact_range(m_model.margin(contact.object_a) + m_model.margin(contact.object_b),
                                        m_model.thickness);
            entry.stiffness = contact_stiffness(zone.bodies[a].mass, mass_b, zone.compliance);
            if (b != kGround && a < zone.dynamic_count && b < zone.dynamic_count)
                zone.pairs.emplace_back(std::min(a, b), std::max(a, b));
            zone.contacts.push_back(entry);
        }
        std::sort(zone.pairs.begin(), zone.pairs.end());
        zone.pairs.erase(std::unique(zone.pairs.begin(), zone.pairs.end()), zone.pairs.end());
        for (ZoneContact& entry : zone.contacts) {
            if (entry.b == kGround || entry.a >= zone.dynamic_count || entry.b >= zone.dynamic_count) continue;
            const std::pair<int, int> key(std::min(entry.a, entry.b), std::max(entry.a, entry.b));
            entry.pair = static_cast<int>(std::lower_bound(zone.pairs.begin(), zone.pairs.end(), key) - zone.pairs.begin());
        }

        evaluate(zone, point);
        Coordinates upstreams;
        for (int b = first_body; b < body_end; ++b) upstreams.push_back(upstream(m_record.zone_bodies[b]));
        const ZoneAdjoint adjoint = zone_adjoint(zone, point, upstreams, m_options.adjoint, m_workspace.zone.system);
        for (int k = 0; k < zone.body_count(); ++k) {
            const int id = zone.bodies[k].id;
            m_local[id] = -1;
            m_pose_gradient[id] += adjoint.pose_gradient[k];
            if (k >= zone.dynamic_count) continue;
            m_multiplier[id] = adjoint.multiplier[k];
            m_parameter_gradient.mass[id] += adjoint.mass_gradient[k];
        }
    }

    void dynamic_body(int i, bool in_zone) {
        const double dt = m_options.dt;
        const BodyState& start = m_record.start[i];
        const BodyStateGradient up = m_gradient[i];
        const Vec6& y = m_record.y[i];
        const FreeRotation& rotation = m_record.free_rotation[i];
        const Mat3 R0 = quaternion_to_matrix(start.orientation);
        const Mat3& inertia_body = m_parameters.inertia[i];
        const double mass = m_parameters.mass[i];

        // M z: what reaches the target ŷ. Without contact M z is the upstream gradient itself.
        Vec6 mass_z = upstream(i);
        Vec3 turn_covector = Vec3::Zero();  // of R0, through M and the contacts
        if (in_zone) {
            const Vec6& z = m_multiplier[i];
            const Mat3 inertia = R0 * inertia_body * R0.transpose();
            mass_z << inertia * z.head<3>(), mass * z.tail<3>();
            const Vec3 target_shift = dt * free_velocity(start, m_control[i], m_parameters, i, dt);
            const Vec3 turn_error = y.head<3>() - rotation.rotation;
            turn_covector -= inertia_rotation_gradient(inertia, turn_error, z.head<3>());
            m_parameter_gradient.inertia[i] -= inertia_body_gradient(R0, turn_error, z.head<3>());
            m_parameter_gradient.mass[i] -= z.tail<3>().dot(y.tail<3>() - target_shift);
        }
        // w1 = ŵ + (turn - target turn) / dt, v1 = v̂ + (shift - dt v̂) / dt = shift / dt
        const Vec3 grad_rotation = mass_z.head<3>() - up.angular_velocity / dt;
        const Vec3 grad_free_velocity = dt * mass_z.tail<3>();
        const FreeRotationGradient free = free_rotation_backward(R0, start.angular_velocity, m_control[i].torque,
                                                                 inertia_body, dt, rotation, up.angular_velocity,
                                                                 grad_rotation);
        BodyStateGradient& out = m_gradient[i];
        const Vec6& pose = m_pose_gradient[i];
        const Vec3 end_covector = up.orientation + pose.head<3>();
        out.orientation = exp_rotation(y.head<3>()).transpose() * end_covector + turn_covector + free.orientation;
        out.position = up.position + pose.tail<3>();
        out.velocity = grad_free_velocity;
        out.angular_velocity = free.angular_velocity;
        m_parameter_gradient.inertia[i] += free.inertia_body;
        m_parameter_gradient.gravity += dt * grad_free_velocity;
        m_parameter_gradient.mass[i] -= dt / (mass * mass) * m_control[i].force.dot(grad_free_velocity);
        m_control_gradient[i].force += dt / mass * grad_free_velocity;
        m_control_gradient[i].torque += free.torque;
    }

    void kinematic_body(int i) {
        const double dt = m_options.dt;
        BodyStateGradient& g = m_gradient[i];
        const Vec3 theta = m_record.y[i].head<3>();
        const Vec3 covector = g.orientation + m_pose_gradient[i].head<3>();
        const Vec3 shift = g.position + m_pose_gradient[i].tail<3>();
        m_control_gradient[i].angular_velocity +=
            g.angular_velocity + dt * left_jacobian(theta).transpose() * covector;
        m_control_gradient[i].velocity += g.velocity + dt * shift;
        g.orientation = exp_rotation(theta).transpose() * covector;
        g.position = shift;
        g.velocity.setZero();
        g.angular_velocity.setZero();
    }

    void static_body(int i) {
        m_gradient[i].orientation += m_pose_gradient[i].head<3>();
        m_gradient[i].position += m_pose_gradient[i].tail<3>();
    }

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneControl& m_control;
    const StepRecord& m_record;
    StepWorkspace& m_workspace;
    std::vector<BodyStateGradient>& m_gradient;
    std::vector<BodyControlGradient>& m_control_gradient;
    ParameterGradient& m_parameter_gradient;
    std::vector<Vec6> m_pose_gradient;  // along the twist of the body at the end of the step
    Coordinates m_multiplier;
    std::vector<int> m_local;  // index in the zone at hand, by body
    Zone m_zone;
};

}  // namespace

std::size_t StepRecord::bytes() const {
    return sizeof(*this) + start.capacity() * sizeof(BodyState) + free_rotation.capacity() * sizeof(FreeRotation) +
           y.capacity() * sizeof(Vec6) + contacts.capacity() * sizeof(Contact) +
           (zone_bodies.capacity() + zone_body_end.capacity() + zone_contact_end.capacity()) * sizeof(int);
}

SceneState step(const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
                const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record) {
    return Stepper(model, options, parameters, state, control, workspace, info).run(record);
}

void step_backward(const Model& model, const Options& options, const Parameters& parameters,
                   const SceneControl& control, const StepRecord& record, StepWorkspace& workspace,
                   std::vector<BodyStateGradient>& gradient, std::vector<BodyControlGradient>& control_gradient,
                   ParameterGradient& parameter_gradient) {
    StepBackward(model, options, parameters, control, record, workspace, gradient, control_gradient,
                 parameter_gradient)
        .run();
}

SceneState separate_state(const Model& model, const Options& options, const Parameters& parameters,
                          const SceneState& state) {
    Zone zone;
    zone.model = &model;
    zone.compliance = options.compliance;
    zone.ground_height = model.ground.height;
    PassiveBodies passive;
    std::vector<Box> boxes;
    for (int i = 0; i < model.body_count(); ++i) {
        const Pose pose{quaternion_to_matrix(state[i].orientation), state[i].position};
        if (!model.bodies[i].is_dynamic()) {
            passive.bodies.push_back({i, pose, Vec6::Zero()});
            boxes.push_back(swept_box({&model.bodies[i].mesh, {pose, pose}, model.bodies[i].margin}));
            continue;
        }
        ZoneBody body;
        body.id = i;
        body.start = pose;
        body.mass = parameters.mass[i];
        body.inertia = pose.R * parameters.inertia[i] * pose.R.transpose();
        body.inverse_inertia = body.inertia.inverse();
        zone.bodies.push_back(body);
    }
    passive.tree = build_box_tree(boxes);
    zone.dynamic_count = zone.body_count();
    if (zone.bodies.empty()) return state;
    const Separation separation = separate(zone, passive);
    SceneState result = state;
    for (std::size_t k = 0; k < separation.poses.size(); ++k) {
        const Pose &from = zone.bodies[k].start, &to = separation.poses[k];
        BodyState& body = result[zone.bodies[k].id];
        body.position = to.t;
        const Mat3 turn = to.R * from.R.transpose();
        if (turn.isIdentity(4.0 * kEpsilon)) continue;
        body.orientation = quaternion_multiply(exp_quaternion(log_rotation(turn)), body.orientation).normalized();
    }
    return result;
}

NearestObjects nearest_objects(const Model& model, const SceneState& state) {
    // Every pair of features, box trees aside: a diagnostic, not part of the step.
    NearestObjects nearest;
    std::vector<Pose> poses;
    for (const BodyState& body : state) poses.push_back({quaternion_to_matrix(body.orientation), body.position});
    const auto consider = [&](double distance, int a, int b) {
        if (distance < nearest.distance) nearest = {distance, a, b};
    };
    for (int a = 0; a < model.body_count(); ++a) {
        if (model.ground.present && model.bodies[a].kind != BodyKind::static_)
            for (int v : model.bodies[a].mesh.active_vertices)
                consider((poses[a] * model.bodies[a].mesh.vertices[v]).z() - model.ground.height -
                             model.bodies[a].margin - model.ground.margin,
                         a, kGround);
        for (int b = a + 1; b < model.body_count(); ++b) {
            if (model.bodies[a].kind == BodyKind::static_ && model.bodies[b].kind == BodyKind::static_) continue;
            const double margins = model.bodies[a].margin + model.bodies[b].margin;
            // Boxes inflated by half of the best distance so far bound what can still improve on it.
            const Pose origin_a{poses[a].R, poses[a].t - poses[a].t}, origin_b{poses[b].R, poses[b].t - poses[a].t};
            const Box box_a = transformed(model.bodies[a].mesh.tree.nodes[0].box, origin_a);
            const Box box_b = transformed(model.bodies[b].mesh.tree.nodes[0].box, origin_b);
            const Vec3 gap = (box_a.lower - box_b.upper).cwiseMax(box_b.lower - box_a.upper).cwiseMax(0.0);
            if (gap.norm() - margins >= nearest.distance) continue;
            double reach = nearest.distance + margins;
            if (reach == kInfinity)
                reach = (poses[a].t - poses[b].t).norm() + model.bodies[a].mesh.radius + model.bodies[b].mesh.radius;
            std::vector<FeaturePair> pairs;
            collect_feature_pairs({&model.bodies[a].mesh, {origin_a, origin_a}, 0.5 * reach},
                                  {&model.bodies[b].mesh, {origin_b, origin_b}, 0.5 * reach}, pairs);
            for (const FeaturePair& f : pairs)
                consider(contact_geometry(model, {a, b, f.type, f.feature_a, f.feature_b}, origin_a, origin_b, 0.0)
                                 .distance -
                             margins,
                         a, b);
        }
    }
    return nearest;
}

}  // namespace diffsim
