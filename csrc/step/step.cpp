#include "step/step.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdio>
#include <stdexcept>
#include <string>
#include <utility>

#include "math/rotation.hpp"
#include "step/failed_objects.hpp"
#include "step/object_groups.hpp"
#include "step/thread_memory.hpp"

namespace diffsim {
namespace {

/// Numbers whose squares are larger count as overflown, be it on the way or in a state: what is computed from smaller ones
/// is finite, and so it is where single precision is asked for.
constexpr double kLargestSquare = 1e76;

constexpr int kMaxBlocked = 2;     // shortenings of a blocked drive before it is stopped
constexpr int kWorthSharing = 64;  // bodies and nodes to be solved for: fewer are done before a thread has woken up
constexpr int kPortionsPerThread = 32;  // of the groups: they take differently long

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point& last) {
    const Clock::time_point now = Clock::now();
    const double seconds = std::chrono::duration<double>(now - last).count();
    last = now;
    return seconds;
}

std::uint64_t mix(std::uint64_t hash, std::uint64_t value) {
    hash ^= value + 0x9e3779b97f4a7c15ull + (hash << 6) + (hash >> 2);
    return hash * 0xff51afd7ed558ccdull;
}

std::uint64_t pack(int high, std::uint32_t low) { return (static_cast<std::uint64_t>(high) << 32) ^ low; }

std::string number(double value) {
    char text[32];
    std::snprintf(text, sizeof text, "%g", value);
    return text;
}

/// What solving one group of bodies gave. Kept at the group's smallest body.
struct GroupOutcome {
    bool solved = false;  ///< by a zone; otherwise the bodies move freely
    ZoneResult result;
    int thread = 0;                          ///< that solved it
    int first_contact = 0, contact_end = 0;  ///< active contacts, in that thread's GroupResults
    double max_compression = 0.0;
    std::uint64_t signature = 0;
};

}  // namespace

struct StepWorkspace::ForwardScratch {
    // One entry per body.
    std::vector<FreeRotation> rotation;
    std::vector<ZoneBody> bodies;
    // One entry per object: the bodies, then the cloths.
    std::vector<GroupOutcome> outcomes;
    std::vector<Box> visited;  ///< world frame, margins included
    std::vector<char> dirty;   ///< groups to be solved, at their smallest object
    ObjectGroups groups;

    std::atomic<bool> overflow{false};
    Coordinates y;
    std::vector<Vec3> elastic_shift;  ///< with split coupling: each node's motion without contact
    PassiveBodies passive;
    std::vector<int> dynamic;  ///< the dynamic bodies
    std::vector<int> movers;   ///< the objects that yield: the dynamic bodies and the cloths
    std::vector<Box> passive_boxes;
    std::vector<ObjectGroup> to_solve;
    std::vector<BlockedDrive> blocked;
    std::vector<ContactList> contact_lists;  ///< of the groups, by their smallest objects
    ZoneFinder zone_finder;
    TouchingZones zones;
};

namespace {

/// One step; its stages are members, its memory is the workspace's.
class Stepper {
public:
    Stepper(
        const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
        const SceneControl& control, StepWorkspace& workspace, StepInfo& info)
        : m_model(model),
          m_options(options),
          m_parameters(parameters),
          m_state(state),
          m_control(control),
          m_workspace(workspace),
          m(*workspace.forward),
          m_info(info) {}

    SceneState run(StepRecord* record) {
        m_info = StepInfo{};
        Clock::time_point clock = Clock::now();
        predict();
        if (m.overflow) return hold(m_state, ZoneStatus::overflow, overflown_objects(m_state), m_info, record);
        if (m_options.split) move_cloths_alone();
        m_info.seconds_motion = seconds_since(clock);
        for (int attempt = 0;; ++attempt) {
            list_passive();
            group();
            m_info.seconds_broad_phase += seconds_since(clock);
            m.blocked.clear();
            do {
                solve_groups();
            } while (merge_met_groups());
            m_info.seconds_zones += seconds_since(clock);
            if (m.blocked.empty()) break;
            shorten_drives(attempt >= kMaxBlocked);
        }
        find_zones();
        const SceneState result = finish();
        if (m.overflow) return hold(m_state, ZoneStatus::overflow, overflown_objects(result), m_info, record);
        if (record != nullptr) write(*record);
        m_info.seconds_motion += seconds_since(clock);
        return result;
    }

private:
    const Body& body(int i) const { return m_model.bodies[i]; }
    int object_count() const { return m_model.body_count() + m_model.cloth_count(); }

    // --- motion without contact --------------------------------------------------------------------------------

    void predict() {
        const int count = m_model.body_count();
        m.overflow = false;
        m.rotation.resize(static_cast<std::size_t>(count));
        m.y.resize(static_cast<std::size_t>(count), static_cast<std::size_t>(m_model.node_count()));
        m.bodies.resize(static_cast<std::size_t>(count));
        m_workspace.workers.for_each_range(count, kBodiesARange, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) {
                predict_body(i);
                if (overflows(i, m_state.bodies[i])) m.overflow = true;
            }
        });
        look_for_overflow_of_cloths(m_state);
        m.dynamic.clear();
        for (int i = 0; i < count; ++i)
            if (body(i).is_dynamic()) m.dynamic.push_back(i);
        m.movers = m.dynamic;
        for (int c = 0; c < m_model.cloth_count(); ++c) m.movers.push_back(count + c);
    }

    void predict_body(int i) {
        const BodyControl& control = m_control.bodies[i];
        m.rotation[i] = {Vec3::Zero(), Vec3::Zero(), 1};
        m.y.bodies[i].setZero();
        if (body(i).kind == BodyKind::kinematic)
            m.y.bodies[i] << m_options.dt * control.angular_velocity, m_options.dt * control.velocity;
        if (!body(i).is_dynamic()) return;
        const Mat3 R = quaternion_to_matrix(m_state.bodies[i].orientation);
        m.rotation[i] =
            free_rotation(R, m_state.bodies[i].angular_velocity, control.torque, m_parameters.inertia[i], m_options.dt);
        m.bodies[i] = moving_body(i, m_state.bodies[i], control, m_parameters, m.rotation[i], m_options.dt);
        m.y.bodies[i] = m.bodies[i].target;
    }

    /// Split coupling, first pass: the cloths as if nothing touched them.
    void move_cloths_alone() {
        m.elastic_shift.resize(static_cast<std::size_t>(m_model.node_count()));
        const PassiveBodies nobody;
        for (int c = 0; c < m_model.cloth_count(); ++c) {
            ZoneMemory& memory = m_workspace.memory().zone;
            Zone& zone = new_zone(memory, origin_of(m_model.body_count() + c));
            zone.contacts_off = true;
            add_cloth(zone, c, m_state, m_control, m_parameters);
            ZoneOptions options = zone_options();
            options.full_steps = m_options.newton_iterations;
            const ZoneResult result = solve_zone(zone, nobody, options, memory.workspace, memory.visited);
            note(result);
            if (result.status != ZoneStatus::converged) fail(m_model.body_count() + c);
            const int first = m_model.cloths[c].first_node;
            for (int i = 0; i < zone.node_count(); ++i) m.elastic_shift[first + i] = memory.workspace.point.y.nodes[i];
        }
    }

    ZoneOptions zone_options() const {
        return {m_options.tolerance, m_options.max_iterations, std::nullopt, m_workspace.interrupt};
    }

    Vec3 origin_of(int object) const {
        return m_model.is_cloth(object) ? m_state.node_position[m_model.cloth_of(object).first_node]
                                        : m.bodies[object].start.t;
    }

    /// The memory's zone, empty.
    Zone& new_zone(ZoneMemory& memory, const Vec3& origin) const {
        return make_zone(memory.zone, m_model, m_parameters.cloths, m_options.compliance, m_options.dt, origin);
    }

    void note(const ZoneResult& result) {
        if (result.status != ZoneStatus::converged) {
            m_info.converged = false;
            if (m_info.status == ZoneStatus::converged) m_info.status = result.status;
        }
        m_info.iterations = std::max(m_info.iterations, result.iterations);
        m_info.residual = std::max(m_info.residual, result.residual);
    }

    void fail(int object) {
        std::vector<int>& failed = m_info.failed_objects;
        const auto place = std::lower_bound(failed.begin(), failed.end(), object);
        if (place == failed.end() || *place != object) failed.insert(place, object);
    }

    /// The group was not solved when it was last tried.
    void fail_group(int root) {
        m_workspace.for_each_memory([&](ThreadMemory& memory) {
            for (const FailedGroup& failed : memory.results.failed)
                if (failed.group == root)
                    for (int object : failed.objects) fail(object);
        });
    }

    // --- overflow ----------------------------------------------------------------------------------------------

    /// At the start or the end of the step: velocities are the motion over dt.
    bool overflows(int i, const BodyState& state) const {
        const double dt_sq = std::min(m_options.dt * m_options.dt, 1.0);
        return !(
            m.y.bodies[i].squaredNorm() <= kLargestSquare * dt_sq && state.position.squaredNorm() <= kLargestSquare);
    }

    /// At the start of the step, where `state` moves as it is driven, or at its end.
    bool cloth_overflows(int c, const SceneState& state) const {
        const Cloth& cloth = m_model.cloths[c];
        for (int k = 0; k < cloth.node_count(); ++k) {
            const int i = cloth.first_node + k;
            const double mass = m_parameters.cloths[c].density * cloth.node_area[k];
            const Vec3& velocity = state.node_velocity[i];
            const Vec3 driven =
                cloth.pinned[k] != 0
                    ? m_control.node_velocity[i]
                    : free_node_velocity(velocity, m_control.node_force[i], mass, m_parameters, m_options.dt);
            if (!(state.node_position[i].squaredNorm() + velocity.squaredNorm() + driven.squaredNorm() <=
                  kLargestSquare))
                return true;
        }
        return false;
    }

    void look_for_overflow_of_cloths(const SceneState& state) {
        for (int c = 0; c < m_model.cloth_count(); ++c)
            if (cloth_overflows(c, state)) m.overflow = true;
    }

    std::vector<int> overflown_objects(const SceneState& state) const {
        std::vector<int> objects;
        for (int i = 0; i < m_model.body_count(); ++i)
            if (overflows(i, state.bodies[i])) objects.push_back(i);
        for (int c = 0; c < m_model.cloth_count(); ++c)
            if (cloth_overflows(c, state)) objects.push_back(m_model.body_count() + c);
        return objects;
    }

    // --- who may meet whom -------------------------------------------------------------------------------------

    void list_passive() {
        m.passive.bodies.clear();
        m.passive_boxes.clear();
        for (int i = 0; i < m_model.body_count(); ++i) {
            if (body(i).is_dynamic()) continue;
            const Pose start{quaternion_to_matrix(m_state.bodies[i].orientation), m_state.bodies[i].position};
            m.passive_boxes.push_back(space_of_driven_body(m_model, i, start, m.y.bodies[i]));
            m.passive.bodies.push_back({i, start, m.y.bodies[i]});
        }
        m.passive.tree = build_box_tree(m.passive_boxes);
    }

    void group() {
        const std::size_t count = static_cast<std::size_t>(object_count());
        m.visited.resize(count);
        m.outcomes.assign(count, GroupOutcome{});
        m.dirty.assign(count, 1);
        m_workspace.for_each_memory([](ThreadMemory& memory) { memory.results.clear(); });
        m.groups.start(object_count(), m.movers);
        const int dynamic_count = static_cast<int>(m.dynamic.size());
        m_workspace.workers.for_each_range(dynamic_count, kBodiesARange, [&](int begin, int end, int) {
            for (int k = begin; k < end; ++k)
                m.groups.space(m.dynamic[k]) = space_of_body(m_model, m.bodies[m.dynamic[k]]);
        });
        for (int c = 0; c < m_model.cloth_count(); ++c) {
            const int object = m_model.body_count() + c;
            m.groups.space(object) = space_of_cloth(
                m_model.cloths[c], m_state, m_control, m_parameters, m_model.own_thickness(object), m_options.dt);
        }
        if (m_options.global_zone)
            m.groups.unite_all();
        else
            m.groups.unite_overlapping();
    }

    bool meets_ground(int i) const {
        return m_model.ground.present &&
               m.groups.space(i).lower.z() <= m_model.ground.height + m_model.ground_margin(i);
    }

    bool meets_passive(int i, std::vector<int>& near) const {
        if (m.passive.bodies.empty()) return false;
        near.clear();
        query(m.passive.tree, m.groups.space(i), near);
        return !near.empty();
    }

    // --- solving -----------------------------------------------------------------------------------------------

    /// Solve the groups marked dirty.
    void solve_groups() {
        m.to_solve.clear();
        int size = 0;
        for (const ObjectGroup& group : m.groups.sorted()) {
            if (!m.dirty[group.root]) continue;
            m.dirty[group.root] = 0;
            m.to_solve.push_back(group);
            size += group.end - group.first;
            if (m_model.is_cloth(m.groups.members()[group.end - 1])) size += kWorthSharing;
        }
        // Which thread solves a group leaves no trace: memory of its own, and results in the order of the groups.
        const int count = static_cast<int>(m.to_solve.size());
        const int portions = size < kWorthSharing ? 1 : kPortionsPerThread * m_workspace.workers.thread_count();
        m_workspace.workers.for_each_range(count, std::max(count / portions, 1), [&](int begin, int end, int thread) {
            for (int k = begin; k < end; ++k) solve_group(m.to_solve[k], thread);
        });
        const auto gathered = static_cast<std::ptrdiff_t>(m.blocked.size());
        m_workspace.for_each_memory([&](ThreadMemory& memory) {
            std::vector<BlockedDrive>& blocked = memory.results.blocked;
            m.blocked.insert(m.blocked.end(), blocked.begin(), blocked.end());
            blocked.clear();
        });
        std::sort(m.blocked.begin() + gathered, m.blocked.end(), [](const BlockedDrive& a, const BlockedDrive& b) {
            return std::pair(a.group, a.body) < std::pair(b.group, b.body);
        });
    }

    void solve_group(const ObjectGroup& group, int thread) {
        const auto [root, first, end] = group;
        const std::vector<int>& members = m.groups.members();
        ThreadMemory& own = m_workspace.memory(thread);
        GroupOutcome& outcome = m.outcomes[root];
        outcome = GroupOutcome{};
        if (end - first == 1 && !m_model.is_cloth(root) && !meets_ground(root) && !meets_passive(root, own.near)) {
            m.y.bodies[root] = m.bodies[root].target;
            m.visited[root] = m.groups.space(root);
            return;
        }
        ZoneMemory& memory = own.zone;
        Zone& zone = new_zone(memory, origin_of(root));
        for (int k = first; k < end; ++k) {  // sorted: bodies come before cloths
            if (m_model.is_cloth(members[k])) {
                add_cloth(zone, members[k] - m_model.body_count(), m_state, m_control, m_parameters);
                continue;
            }
            zone.bodies.push_back(m.bodies[members[k]]);
            zone.bodies.back().start.t -= zone.origin;
        }
        zone.dynamic_count = zone.body_count();
        if (m_options.split) {
            zone.elastic = false;
            for (const ZoneCloth& cloth : zone.cloths)
                for (int k = 0; k < m_model.cloths[cloth.id].node_count(); ++k)
                    zone.nodes[cloth.first_node + k].target = m.elastic_shift[m_model.cloths[cloth.id].first_node + k];
        }
        outcome.solved = true;
        outcome.result = solve_zone(zone, m.passive, zone_options(), memory.workspace, memory.visited);
        const ZonePoint& point = memory.workspace.point;
        if (outcome.result.status == ZoneStatus::bad_start)
            refuse_start(zone.contacts[outcome.result.worst_contact], point.distances[outcome.result.worst_contact]);
        for (int k = first; k < end; ++k) {
            const int i = members[k];
            m.visited[i] = memory.visited[k - first];
            m.visited[i].inflate(m_model.margin(i));
            m.visited[i].lower += zone.origin;
            m.visited[i].upper += zone.origin;
            if (!m_model.is_cloth(i)) m.y.bodies[i] = point.y.bodies[k - first];
        }
        for (const ZoneCloth& cloth : zone.cloths)
            for (int k = 0; k < m_model.cloths[cloth.id].node_count(); ++k)
                m.y.nodes[m_model.cloths[cloth.id].first_node + k] = point.y.nodes[cloth.first_node + k];
        outcome.thread = thread;
        keep_contacts(zone, point, outcome, own.results);
        if (outcome.result.status == ZoneStatus::converged) return;
        std::vector<int> blocked;
        for (int k = zone.dynamic_count; k < zone.body_count(); ++k) {
            if (point.y.bodies[k] == zone.bodies[k].target) continue;
            own.results.blocked.push_back({root, zone.bodies[k].id, point.y.bodies[k]});
            blocked.push_back(zone.bodies[k].id);
        }
        own.results.failed.push_back(
            {root, blocked.empty() ? unbalanced_objects(zone, point) : squeezed_objects(zone, point, blocked)});
    }

    static void keep_contacts(const Zone& zone, const ZonePoint& point, GroupOutcome& outcome, GroupResults& results) {
        outcome.first_contact = static_cast<int>(results.contacts.size());
        for (const ActiveContact& active : point.active) {
            const ZoneContact& contact = zone.contacts[active.index];
            const Contact& c = contact.contact;
            results.contacts.push_back(c);
            results.exact.push_back({contact.law.shift, zone.contacts.memory.compliance});
            outcome.max_compression = std::max(
                outcome.max_compression, contact.law.range.rest - contact.law.shift - active.geometry.distance);
            std::uint64_t& hash = outcome.signature;
            hash = mix(hash, pack(c.object_a, static_cast<std::uint32_t>(c.object_b)));
            hash = mix(hash, pack(c.feature_a, static_cast<std::uint32_t>(c.feature_b)));
            hash = mix(hash, pack(static_cast<int>(c.type), active.geometry.closest.feature_code));
        }
        outcome.contact_end = static_cast<int>(results.contacts.size());
    }

    [[noreturn]] void refuse_start(const ZoneContact& contact, double distance) const {
        throw PenetratingStart(
            "state: '" + m_model.name(contact.contact.object_a) + "' and '" + m_model.name(contact.contact.object_b) +
                "' penetrate: their meshes are " + number(distance) + " m apart, where at rest they keep " +
                number(contact.law.range.rest) + " m; move them apart, for instance with sim.separate(state)",
            contact.contact.object_a, contact.contact.object_b);
    }

    /// Groups whose objects were pushed to where they may have met others are to be solved again, together. False if there
    /// are none.
    bool merge_met_groups() {
        const auto joined = m.groups.include_visited(m.visited);
        for (const auto& [i, j] : joined) {
            m.outcomes[i] = m.outcomes[j] = GroupOutcome{};
            m.dirty[std::min(i, j)] = 1;
        }
        return !joined.empty();
    }

    /// What drives could not do for one zone they must not do for any.
    void shorten_drives(bool stop) {
        m_info.converged = false;
        m_info.status = ZoneStatus::blocked;
        for (const BlockedDrive& blocked : m.blocked) {
            fail_group(blocked.group);
            Vec6& y = m.y.bodies[blocked.body];
            if (stop)
                y.setZero();
            else if (blocked.reached.squaredNorm() < y.squaredNorm())
                y = blocked.reached;
        }
    }

    // --- results -----------------------------------------------------------------------------------------------

    /// What touches now, group after group, as zones.
    void find_zones() {
        m.contact_lists.clear();
        for (int root : m.movers) {
            const GroupOutcome& outcome = m.outcomes[root];
            const GroupResults& results = m_workspace.memory(outcome.thread).results;
            const int first = outcome.first_contact;
            m.contact_lists.push_back(
                {results.contacts.data() + first, results.exact.data() + first, outcome.contact_end - first});
        }
        m.zone_finder.find(
            m_model, m.movers, m.contact_lists, m_options.compliance == 0.0, m_options.global_zone, m.zones);
        m_info.contacts = static_cast<int>(m.zones.contacts.size());
        int body = 0, cloth = 0, contact = 0;
        for (int z = 0; z < m.zones.count(); ++z) {
            const int body_count = m.zones.body_end[z] - std::exchange(body, m.zones.body_end[z]);
            const int cloth_count = m.zones.cloth_end[z] - std::exchange(cloth, m.zones.cloth_end[z]);
            if (std::exchange(contact, m.zones.contact_end[z]) == m.zones.contact_end[z]) continue;
            ++m_info.zones;
            m_info.largest_zone = std::max(m_info.largest_zone, body_count + cloth_count);
        }
    }

    SceneState finish() {
        const double dt = m_options.dt;
        for (int root : m.movers) {
            const GroupOutcome& outcome = m.outcomes[root];
            if (!outcome.solved) continue;
            note(outcome.result);
            if (outcome.result.status != ZoneStatus::converged) fail_group(root);
            m_info.fast_impacts += outcome.result.fast_impacts;
            m_info.max_compression = std::max(m_info.max_compression, outcome.max_compression);
            m_info.signature = mix(m_info.signature, outcome.signature);
        }
        for (int i : m.dynamic) {
            if (m.rotation[i].substeps > 0) continue;
            m_info.converged = false;
            if (m_info.status == ZoneStatus::converged) m_info.status = ZoneStatus::spinning;
            fail(i);
        }
        SceneState result = m_state;
        m_workspace.workers.for_each_range(m_model.body_count(), kBodiesARange, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) {
                finish_body(i, result.bodies[i]);
                if (overflows(i, result.bodies[i])) m.overflow = true;
            }
        });
        for (const Cloth& cloth : m_model.cloths) {
            for (int k = 0; k < cloth.node_count(); ++k) {
                const int node = cloth.first_node + k;
                result.node_position[node] += m.y.nodes[node];
                result.node_velocity[node] =
                    cloth.pinned[k] && m_info.converged ? m_control.node_velocity[node] : Vec3(m.y.nodes[node] / dt);
            }
        }
        look_for_overflow_of_cloths(result);
        return result;
    }

    /// From the start of the step to its end.
    void finish_body(int i, BodyState& end) const {
        const double dt = m_options.dt;
        const Vec3 turn = m.y.bodies[i].head<3>(), shift = m.y.bodies[i].tail<3>();
        if (!turn.isZero(0.0)) {
            end.orientation = quaternion_multiply(exp_quaternion(turn), end.orientation);
            end.orientation /= end.orientation.norm();
        }
        end.position += shift;
        switch (body(i).kind) {
            case BodyKind::dynamic:
                // w1 = turn / dt and v1 = shift / dt, written so that free bodies keep exactly what free motion gives.
                end.angular_velocity = m.rotation[i].angular_velocity + (turn - m.rotation[i].rotation) / dt;
                end.velocity = free_velocity(i, m_state.bodies[i], m_control.bodies[i], m_parameters, dt) +
                               (shift - m.bodies[i].target.tail<3>()) / dt;
                break;
            case BodyKind::kinematic:
                end.angular_velocity = m_info.converged ? m_control.bodies[i].angular_velocity : Vec3(turn / dt);
                end.velocity = m_info.converged ? m_control.bodies[i].velocity : Vec3(shift / dt);
                break;
            case BodyKind::static_:
                break;
        }
    }

    void write(StepRecord& record) const {
        record.start = m_state;
        record.free_rotation = m.rotation;
        record.y = m.y;
        record.zones = m.zones;
        if (m_options.split) record.elastic_shift = m.elastic_shift;
    }

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneState& m_state;
    const SceneControl& m_control;
    StepWorkspace& m_workspace;
    StepWorkspace::ForwardScratch& m;
    StepInfo& m_info;
};

}  // namespace

StepWorkspace::StepWorkspace(int thread_count)
    : forward(std::make_unique<ForwardScratch>()),
      m_memory(static_cast<std::size_t>(thread_count)),
      workers(thread_count, [this](int thread) { m_memory[thread].reset(); }) {}

StepWorkspace::~StepWorkspace() = default;

ThreadMemory& StepWorkspace::memory(int thread) {
    std::unique_ptr<ThreadMemory>& memory = m_memory[thread];
    if (!memory) memory = std::make_unique<ThreadMemory>();
    return *memory;
}

std::size_t StepRecord::bytes() const {
    return sizeof(*this) + start.bodies.capacity() * sizeof(BodyState) +
           free_rotation.capacity() * sizeof(FreeRotation) + y.bodies.capacity() * sizeof(Vec6) +
           (start.node_position.capacity() + start.node_velocity.capacity() + y.nodes.capacity() +
            elastic_shift.capacity()) *
               sizeof(Vec3) +
           zones.bytes();
}

SceneState step(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
    const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record) {
    return Stepper(model, options, parameters, state, control, workspace, info).run(record);
}

SceneState hold(
    const SceneState& state, ZoneStatus status, std::vector<int> objects, StepInfo& info, StepRecord* record) {
    info = StepInfo{};
    info.converged = false;
    info.status = status;
    info.failed_objects = std::move(objects);
    if (record != nullptr) {
        *record = StepRecord{};
        record->start = state;
        record->held = true;
    }
    return state;
}

}  // namespace diffsim
