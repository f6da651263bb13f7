#include "step/step.hpp"

#include <algorithm>
#include <atomic>
#include <chrono>
#include <utility>

#include "math/rotation.hpp"
#include "step/body_step.hpp"
#include "step/cloth_step.hpp"
#include "step/driven_bodies.hpp"
#include "step/group_step.hpp"
#include "step/step_part.hpp"

namespace diffsim {
namespace {

constexpr int kMaxBlocked = 2;  // shortenings of a blocked drive before it is stopped

using Clock = std::chrono::steady_clock;

double seconds_since(Clock::time_point& last) {
    const Clock::time_point now = Clock::now();
    const double seconds = std::chrono::duration<double>(now - last).count();
    last = now;
    return seconds;
}

}  // namespace

struct StepWorkspace::ForwardScratch {
    // One entry per body.
    std::vector<FreeRotation> rotation;
    std::vector<ZoneBody> bodies;  ///< the dynamic ones
    // One entry per object: the bodies, then the cloths.
    std::vector<GroupOutcome> outcomes;
    std::vector<Box> swept;   ///< world frame, margins included
    std::vector<char> dirty;  ///< groups to be solved, at their smallest object
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
        const StepSetting& setting, const Options& options, const SceneState& state, const SceneControl& control,
        StepWorkspace& workspace, StepInfo& info)
        : m_model(setting.model),
          m_options(options),
          m_state(state),
          m_control(control),
          m_workspace(workspace),
          m_scratch(*workspace.forward),
          m_info(info),
          m_setting(setting),
          m_group_step(setting, options, state, control, workspace.interrupt) {}

    SceneState run(StepRecord* record) {
        m_info = StepInfo{};
        Clock::time_point clock = Clock::now();
        predict();
        if (m_scratch.overflow) return hold(m_state, StepStatus::overflow, overflown_objects(m_state), m_info, record);
        if (m_options.split) move_cloths_alone();
        m_info.seconds_motion = seconds_since(clock);
        for (int attempt = 0;; ++attempt) {
            list_passive();
            if (attempt == 0 && stop_at_static_bodies()) list_passive();
            group();
            m_info.seconds_broad_phase += seconds_since(clock);
            m_scratch.blocked.clear();
            do {
                solve_groups();
            } while (merge_met_groups());
            m_info.seconds_zones += seconds_since(clock);
            if (m_scratch.blocked.empty()) break;
            shorten_drives(attempt >= kMaxBlocked);
        }
        find_zones();
        const SceneState result = finish();
        if (m_scratch.overflow) return hold(m_state, StepStatus::overflow, overflown_objects(result), m_info, record);
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
        m_scratch.overflow = false;
        m_scratch.rotation.resize(static_cast<std::size_t>(count));
        m_scratch.y.resize(static_cast<std::size_t>(count), static_cast<std::size_t>(m_model.node_count()));
        m_scratch.bodies.resize(static_cast<std::size_t>(count));
        m_workspace.workers.for_each_range(count, kBodiesARange, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) {
                predict_body(i);
                if (overflows(i, m_state.bodies[i])) m_scratch.overflow = true;
            }
        });
        look_for_overflow_of_cloths(m_state);
        m_scratch.dynamic.clear();
        for (int i = 0; i < count; ++i)
            if (body(i).is_dynamic()) m_scratch.dynamic.push_back(i);
        m_scratch.movers = m_scratch.dynamic;
        for (int c = 0; c < m_model.cloth_count(); ++c) m_scratch.movers.push_back(count + c);
    }

    void predict_body(int i) {
        const BodyStart start = begin_body(m_setting, i, m_state.bodies[i], m_control.bodies[i]);
        m_scratch.rotation[i] = start.rotation;
        m_scratch.bodies[i] = start.body;
        m_scratch.y.bodies[i] = start.motion;
    }

    /// Split coupling, first pass: the cloths as if nothing touched them.
    void move_cloths_alone() {
        m_scratch.elastic_shift.resize(static_cast<std::size_t>(m_model.node_count()));
        for (int c = 0; c < m_model.cloth_count(); ++c) {
            ZoneMemory& memory = m_workspace.memory().zone;
            const ZoneResult result = m_group_step.solve_elastic(c, memory);
            note(result);
            if (result.status != StepStatus::converged) fail(m_model.body_count() + c);
            const std::vector<Vec3>& shift = memory.workspace.point.y.nodes;
            std::copy(shift.begin(), shift.end(), m_scratch.elastic_shift.begin() + m_model.cloths[c].first_node);
        }
    }

    void note(const ZoneResult& result) {
        if (result.status != StepStatus::converged) {
            m_info.converged = false;
            if (m_info.status == StepStatus::converged) m_info.status = result.status;
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

    /// At the start or the end of the step.
    bool overflows(int i, const BodyState& state) const {
        return body_overflows(state, m_scratch.y.bodies[i], m_options.dt);
    }

    void look_for_overflow_of_cloths(const SceneState& state) {
        for (int c = 0; c < m_model.cloth_count(); ++c)
            if (cloth_overflows(m_setting, c, state, m_control)) m_scratch.overflow = true;
    }

    std::vector<int> overflown_objects(const SceneState& state) const {
        std::vector<int> objects;
        for (int i = 0; i < m_model.body_count(); ++i)
            if (overflows(i, state.bodies[i])) objects.push_back(i);
        for (int c = 0; c < m_model.cloth_count(); ++c)
            if (cloth_overflows(m_setting, c, state, m_control)) objects.push_back(m_model.body_count() + c);
        return objects;
    }

    // --- who may meet whom -------------------------------------------------------------------------------------

    void list_passive() {
        m_scratch.passive.bodies.clear();
        m_scratch.passive_boxes.clear();
        for (int i = 0; i < m_model.body_count(); ++i) {
            if (body(i).is_dynamic()) continue;
            const Pose start{quaternion_to_matrix(m_state.bodies[i].orientation), m_state.bodies[i].position};
            m_scratch.passive_boxes.push_back(space_of_driven_body(m_model, i, start, m_scratch.y.bodies[i]));
            m_scratch.passive.bodies.push_back({i, start, m_scratch.y.bodies[i]});
        }
        m_scratch.passive.tree = build_box_tree(m_scratch.passive_boxes);
    }

    /// Driven bodies that have a static one in their way go as far as there is room. Whether there were any.
    bool stop_at_static_bodies() {
        bool any = false;
        for (const PassiveBody& driven : m_scratch.passive.bodies) {
            if (driven.target.isZero(0.0)) continue;
            const DriveStop stop = find_static_obstacle(m_model, m_scratch.passive, driven);
            if (stop.obstacle == kNobody) continue;
            m_scratch.y.bodies[driven.id] *= stop.part;
            m_info.converged = false;
            m_info.status = StepStatus::blocked;
            fail(driven.id);
            fail(stop.obstacle);
            any = true;
        }
        return any;
    }

    void group() {
        const std::size_t count = static_cast<std::size_t>(object_count());
        m_scratch.swept.resize(count);
        m_scratch.outcomes.assign(count, GroupOutcome{});
        m_scratch.dirty.assign(count, 1);
        m_workspace.for_each_memory([](ThreadMemory& memory) { memory.results.clear(); });
        m_scratch.groups.start(object_count(), m_scratch.movers);
        const int dynamic_count = static_cast<int>(m_scratch.dynamic.size());
        m_workspace.workers.for_each_range(dynamic_count, kBodiesARange, [&](int begin, int end, int) {
            for (int k = begin; k < end; ++k)
                m_scratch.groups.space(m_scratch.dynamic[k]) =
                    space_of_body(m_model, m_scratch.bodies[m_scratch.dynamic[k]]);
        });
        for (int c = 0; c < m_model.cloth_count(); ++c) {
            const int object = m_model.body_count() + c;
            m_scratch.groups.space(object) = space_of_cloth(m_setting, c, m_state, m_control);
        }
        if (m_options.global_zone)
            m_scratch.groups.unite_all();
        else
            m_scratch.groups.unite_overlapping();
    }

    bool meets_ground(int i) const {
        return m_model.ground.present &&
               m_scratch.groups.space(i).lower.z() <= m_model.ground.height + m_model.ground_margin(i);
    }

    bool meets_passive(int i, std::vector<int>& near) const {
        if (m_scratch.passive.bodies.empty()) return false;
        near.clear();
        query(m_scratch.passive.tree, m_scratch.groups.space(i), near);
        return !near.empty();
    }

    // --- solving -----------------------------------------------------------------------------------------------

    /// Solve the groups marked dirty.
    void solve_groups() {
        m_scratch.to_solve.clear();
        int size = 0;
        for (const ObjectGroup& group : m_scratch.groups.sorted()) {
            if (!m_scratch.dirty[group.root]) continue;
            m_scratch.dirty[group.root] = 0;
            m_scratch.to_solve.push_back(group);
            size += group.end - group.first;
            if (m_model.is_cloth(m_scratch.groups.members()[group.end - 1])) size += kWorthSharing;
        }
        // Which thread solves a group leaves no trace: memory of its own, and results in the order of the groups.
        const int count = static_cast<int>(m_scratch.to_solve.size());
        const int portions = size < kWorthSharing ? 1 : kPortionsPerThread * m_workspace.workers.thread_count();
        m_workspace.workers.for_each_range(count, std::max(count / portions, 1), [&](int begin, int end, int thread) {
            for (int k = begin; k < end; ++k) solve_group(m_scratch.to_solve[k], thread);
        });
        const auto gathered = static_cast<std::ptrdiff_t>(m_scratch.blocked.size());
        m_workspace.for_each_memory([&](ThreadMemory& memory) {
            std::vector<BlockedDrive>& blocked = memory.results.blocked;
            m_scratch.blocked.insert(m_scratch.blocked.end(), blocked.begin(), blocked.end());
            blocked.clear();
        });
        std::sort(
            m_scratch.blocked.begin() + gathered, m_scratch.blocked.end(),
            [](const BlockedDrive& a, const BlockedDrive& b) {
                return std::pair(a.group, a.body) < std::pair(b.group, b.body);
            });
    }

    void solve_group(const ObjectGroup& group, int thread) {
        ThreadMemory& own = m_workspace.memory(thread);
        GroupOutcome& outcome = m_scratch.outcomes[group.root];
        if (is_not_asked_for(group) || moves_freely(group, own.near)) {
            outcome = GroupOutcome{};
            for (int k = group.first; k < group.end; ++k) {
                const int body = m_scratch.groups.members()[k];
                m_scratch.y.bodies[body] = m_scratch.bodies[body].target;
                m_scratch.swept[body] = m_scratch.groups.space(body);
            }
            return;
        }
        outcome = m_group_step.solve(
            group, m_scratch.groups.members(),
            {m_scratch.bodies, m_scratch.elastic_shift, m_scratch.passive, m_scratch.y, m_scratch.swept}, own);
        outcome.thread = thread;
    }

    /// A first stage is for cloth.
    bool is_not_asked_for(const ObjectGroup& group) const {
        return m_setting.part == StepPart::first_stage && !m_model.is_cloth(m_scratch.groups.members()[group.end - 1]);
    }

    bool moves_freely(const ObjectGroup& group, std::vector<int>& near) const {
        return group.end - group.first == 1 && !m_model.is_cloth(group.root) && !meets_ground(group.root) &&
               !meets_passive(group.root, near);
    }

    /// Groups whose objects were pushed to where they may have met others are to be solved again,
    /// together. False if there are none.
    bool merge_met_groups() {
        const auto joined = m_scratch.groups.include_swept(m_scratch.swept);
        for (const auto& [i, j] : joined) {
            m_scratch.outcomes[i] = m_scratch.outcomes[j] = GroupOutcome{};
            m_scratch.dirty[std::min(i, j)] = 1;
        }
        return !joined.empty();
    }

    /// What drives could not do for one zone they must not do for any.
    void shorten_drives(bool stop) {
        m_info.converged = false;
        m_info.status = StepStatus::blocked;
        for (const BlockedDrive& blocked : m_scratch.blocked) {
            fail_group(blocked.group);
            Vec6& y = m_scratch.y.bodies[blocked.body];
            if (stop)
                y.setZero();
            else if (blocked.reached.squaredNorm() < y.squaredNorm())
                y = blocked.reached;
        }
    }

    // --- results -----------------------------------------------------------------------------------------------

    /// What touches now, group after group, as zones.
    void find_zones() {
        m_scratch.contact_lists.clear();
        for (int root : m_scratch.movers) {
            const GroupOutcome& outcome = m_scratch.outcomes[root];
            const GroupResults& results = m_workspace.memory(outcome.thread).results;
            const int first = outcome.first_contact;
            m_scratch.contact_lists.push_back(
                {results.contacts.data() + first, results.exact.data() + first,
                 results.friction.empty() ? nullptr : results.friction.data() + first, outcome.contact_end - first});
        }
        m_scratch.zone_finder.find(
            m_model, m_scratch.movers, m_scratch.contact_lists,
            {m_options.compliance == 0.0, !m_setting.parameters.friction.empty(), m_options.global_zone},
            m_scratch.zones);
        m_info.contacts = static_cast<int>(m_scratch.zones.contacts.size());
        int body = 0, cloth = 0, contact = 0;
        for (int z = 0; z < m_scratch.zones.count(); ++z) {
            const int body_count = m_scratch.zones.body_end[z] - std::exchange(body, m_scratch.zones.body_end[z]);
            const int cloth_count = m_scratch.zones.cloth_end[z] - std::exchange(cloth, m_scratch.zones.cloth_end[z]);
            if (std::exchange(contact, m_scratch.zones.contact_end[z]) == m_scratch.zones.contact_end[z]) continue;
            ++m_info.zones;
            m_info.largest_zone = std::max(m_info.largest_zone, body_count + cloth_count);
        }
    }

    SceneState finish() {
        for (int root : m_scratch.movers) {
            const GroupOutcome& outcome = m_scratch.outcomes[root];
            if (!outcome.solved) continue;
            note(outcome.result);
            if (outcome.result.status != StepStatus::converged) fail_group(root);
            m_info.fast_impacts += outcome.result.fast_impacts;
            m_info.sticking += outcome.sticking;
            m_info.slipping += outcome.slipping;
            m_info.max_compression = std::max(m_info.max_compression, outcome.max_compression);
            m_info.signature = mix(m_info.signature, outcome.signature);
        }
        for (int i : m_scratch.dynamic) {
            if (m_scratch.rotation[i].substeps > 0) continue;
            m_info.converged = false;
            if (m_info.status == StepStatus::converged) m_info.status = StepStatus::spinning;
            fail(i);
        }
        SceneState result = m_state;
        m_workspace.workers.for_each_range(m_model.body_count(), kBodiesARange, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) {
                result.bodies[i] = end_body(
                    m_setting, {m_scratch.rotation[i], m_scratch.bodies[i]}, i, m_state.bodies[i], m_control.bodies[i],
                    m_scratch.y.bodies[i], m_info.converged);
                if (overflows(i, result.bodies[i])) m_scratch.overflow = true;
            }
        });
        for (int c = 0; c < m_model.cloth_count(); ++c)
            end_cloth(m_setting, c, m_control, m_scratch.y.nodes, m_info.converged, result);
        look_for_overflow_of_cloths(result);
        return result;
    }

    void write(StepRecord& record) const {
        record.start = m_state;
        record.free_rotation = m_scratch.rotation;
        record.y = m_scratch.y;
        record.zones = m_scratch.zones;
        if (m_options.split) record.elastic_shift = m_scratch.elastic_shift;
        if (m_setting.after_first_stage()) record.first_stage = *m_setting.first_stage;
    }

    const Model& m_model;
    const Options& m_options;
    const SceneState& m_state;
    const SceneControl& m_control;
    StepWorkspace& m_workspace;
    StepWorkspace::ForwardScratch& m_scratch;
    StepInfo& m_info;
    const StepSetting m_setting;
    const GroupStep m_group_step;
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

void StepInfo::add_effort(const StepInfo& other) {
    iterations = std::max(iterations, other.iterations);
    residual = std::max(residual, other.residual);
    seconds_motion += other.seconds_motion;
    seconds_broad_phase += other.seconds_broad_phase;
    seconds_zones += other.seconds_zones;
}

std::size_t StepRecord::bytes() const {
    return sizeof(*this) + start.bodies.capacity() * sizeof(BodyState) +
           free_rotation.capacity() * sizeof(FreeRotation) + y.bodies.capacity() * sizeof(Vec6) +
           (start.node_position.capacity() + start.node_velocity.capacity() + y.nodes.capacity() +
            elastic_shift.capacity() + first_stage.capacity()) *
               sizeof(Vec3) +
           zones.bytes() + (velocities ? velocities->bytes() : 0) + (stage ? stage->bytes() : 0) +
           (next ? next->bytes() : 0);
}

SceneState solve_part(
    const StepSetting& setting, const Options& options, const SceneState& state, const SceneControl& control,
    StepWorkspace& workspace, StepInfo& info, StepRecord* record) {
    return Stepper(setting, options, state, control, workspace, info).run(record);
}

SceneState hold(
    const SceneState& state, StepStatus status, std::vector<int> objects, StepInfo& info, StepRecord* record) {
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
