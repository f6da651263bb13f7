#pragma once

#include "step/step.hpp"

/// Zones of a recorded step, for its backward.
namespace diffsim {

/// What the schemes were given in a recorded step; keeps references to all it is given.
inline StepSetting setting_of(
    const Model& model, const Options& options, const Parameters& parameters, const StepRecord& record) {
    return {model, parameters, options.dt, options.part, &record.first_stage};
}

/// The zones of a step that was taken, put together again from its record. Keeps references to all it is given.
class RecordedZones {
public:
    RecordedZones(
        const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
        const StepRecord& record)
        : m_model(model),
          m_options(options),
          m_parameters(parameters),
          m_control(control),
          m_record(record),
          m_setting(setting_of(model, options, parameters, record)) {}

    int count() const { return static_cast<int>(m_record.zones.body_end.size()); }

    /// memory.zone becomes a zone with its active contacts only, memory.workspace.point the zone at the end of the
    /// step. With split coupling the zone is that of the contact pass. `local` is memory that calls reuse.
    void rebuild(int index, ZoneMemory& memory, std::vector<int>& local) const;

private:
    /// Where a zone's bodies, cloths and contacts begin or end in the record.
    struct Range {
        int body = 0, cloth = 0, contact = 0;
    };
    Range end_of(int index) const;
    void add_objects(const Range& first, const Range& end, ZoneMemory& memory, std::vector<int>& local) const;
    void join_body(ZoneMemory& memory, std::vector<int>& local, int id) const;
    void join_cloth(ZoneMemory& memory, std::vector<int>& local, int id) const;
    void list_contacts(const Range& first, const Range& end, ZoneMemory& memory, std::vector<int>& local) const;

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneControl& m_control;
    const StepRecord& m_record;
    const StepSetting m_setting;
};

}  // namespace diffsim
