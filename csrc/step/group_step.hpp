#pragma once

#include <cstdint>

#include "step/object_groups.hpp"
#include "step/thread_memory.hpp"

/// One group of objects that may meet, over one step: one zone.
namespace diffsim {

/// What solving one group gave. Kept at the group's smallest object.
struct GroupOutcome {
    bool solved = false;  ///< by a zone; otherwise the bodies move freely
    ZoneResult result;
    int thread = 0;                          ///< that solved it
    int first_contact = 0, contact_end = 0;  ///< active contacts, in that thread's GroupResults
    double max_compression = 0.0;
    int sticking = 0, slipping = 0;  ///< contacts with friction
    std::uint64_t signature = 0;
};

std::uint64_t mix(std::uint64_t hash, std::uint64_t value);

/// What all groups of a step share. Keeps references to all it is given.
class GroupStep {
public:
    GroupStep(
        const StepSetting& setting, const Options& options, const SceneState& state, const SceneControl& control,
        Interrupt* interrupt)
        : m_setting(setting),
          m_model(setting.model),
          m_options(options),
          m_parameters(setting.parameters),
          m_state(state),
          m_control(control),
          m_interrupt(interrupt) {}

    /// Where a group's objects begin, and where they go; one entry per object of the scene.
    struct Objects {
        const std::vector<ZoneBody>& bodies;     ///< the dynamic ones at their start
        const std::vector<Vec3>& elastic_shift;  ///< with split coupling: each node's motion without contact
        const PassiveBodies& passive;
        Coordinates& y;           ///< receives the motion of those that yield
        std::vector<Box>& swept;  ///< receives the space that they went through: world frame, margins included
    };

    /// Solve a group whose objects `members` lists. Contacts, blocked drives and who failed are added to the thread's
    /// results. Throws PenetratingStart.
    GroupOutcome solve(
        const ObjectGroup& group, const std::vector<int>& members, const Objects& objects, ThreadMemory& memory) const;

    /// Split coupling, first pass: a cloth as if nothing touched it. The zone is the memory's.
    ZoneResult solve_elastic(int cloth, ZoneMemory& memory) const;

private:
    ZoneOptions zone_options() const;
    Zone& new_zone(ZoneMemory& memory, const Vec3& origin) const;
    void join(const ObjectGroup& group, const std::vector<int>& members, const Objects& objects, Zone& zone) const;
    bool has_friction(const ObjectGroup& group, const std::vector<int>& members) const;
    void write_motion(
        const ObjectGroup& group, const std::vector<int>& members, const ZoneMemory& memory,
        const Objects& objects) const;
    [[noreturn]] void refuse_start(const ZoneContact& contact, double distance) const;

    const StepSetting m_setting;
    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneState& m_state;
    const SceneControl& m_control;
    Interrupt* m_interrupt;
};

}  // namespace diffsim
