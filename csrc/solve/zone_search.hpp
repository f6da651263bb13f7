#pragma once

#include "solve/zone_path.hpp"
#include "solve/zone_solver.hpp"
#include "zone/zone_accuracy.hpp"

/// Where the solve of a zone is, and what the ways to its solution share.
namespace diffsim {

/// How much of what rounding leaves undone is good enough where nothing better can be found, times the tolerance.
inline constexpr double kGoodEnough = 1e3;
/// Of the way that is left to driven bodies: where something is squeezed, less is no progress.
inline constexpr double kSqueeze = 0.1;

class ZoneSearch {
public:
    ZoneSearch(
        Zone& zone, const PassiveBodies& passive, const ZoneOptions& options, ZoneWorkspace& workspace,
        std::vector<Box>& swept)
        : m_zone(zone),
          m_options(options),
          m_work(workspace),
          m_swept(swept),
          m_path(zone, passive, workspace.point, workspace.trial, workspace.coverage, workspace.system) {}

    Coordinates& y() { return m_work.point.y; }
    void fail(StepStatus status) { m_result.status = status; }

    /// Go to the trial.
    void accept_trial();
    void mark_swept();

    /// Whether all that is driven has reached its target.
    bool drives_done() const;
    /// Go along with driven bodies as far as allowed, whatever the energy: they must reach their targets.
    /// Where there is no room at all, what is in the way may make some in steps of its own. `stalls`
    /// counts the steps that get nowhere.
    enum class DriveProgress { moved, waits, blocked };
    DriveProgress advance_drives(double step, int& stalls);

    Accuracy current_accuracy();
    double current_noise();

    const Zone& m_zone;  // its contacts change by m_path alone
    const ZoneOptions& m_options;
    ZoneWorkspace& m_work;
    std::vector<Box>& m_swept;
    ZonePath m_path;
    ZoneResult m_result;
};

}  // namespace diffsim
