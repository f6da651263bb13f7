#include <algorithm>
#include <memory>
#include <utility>
#include <vector>

#include "step/group_step.hpp"
#include "step/time_scheme.hpp"

/// A step whose solution is not found is taken in two halves, and these in theirs: over a shorter time things move
/// less, and contacts turn less from where models of them are true. What is found so is a step like any other, and has
/// its gradient.
namespace diffsim {
namespace {

constexpr int kMaxHalvings = 3;
constexpr int kMaxFailures = 4;  // searches of a step that found nothing

/// Where a search was given up. What is blocked or overflows is so in shorter steps, too, and bodies that meet fast may
/// come around each other from one to the next.
bool is_given_up(const StepInfo& info) {
    if (info.fast_impacts > 0) return false;
    switch (info.status) {
        case StepStatus::crawls:
        case StepStatus::no_descent:
        case StepStatus::too_many_iterations:
            return true;
        default:
            return false;
    }
}

/// What a search that found nothing took.
void add_trial(const StepInfo& trial, StepInfo& info) {
    const double residual = info.residual;
    info.add_effort(trial);
    info.residual = residual;
}

/// Let `info` speak of one more part of the step.
void add_part(StepInfo part, StepInfo& info) {
    part.add_effort(info);
    part.fast_impacts += info.fast_impacts;
    part.max_compression = std::max(part.max_compression, info.max_compression);
    part.signature = mix(info.signature, part.signature);
    part.substeps = info.substeps + 1;
    info = std::move(part);
}

Options halved(const Options& options, int halvings) {
    return halvings == 0 ? options : over_part(options, 1.0 / (1 << halvings));
}

/// One step, as long as it may take.
class Refinement {
public:
    Refinement(
        const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
        StepWorkspace& workspace)
        : m_model(model), m_options(options), m_parameters(parameters), m_control(control), m_workspace(workspace) {}

    SceneState run(const SceneState& state, StepInfo& info, StepRecord* record) {
        SceneState end = attempt(state, 0, info, record);
        if (!is_given_up(info)) return end;
        StepInfo parts;
        parts.substeps = 0;
        add_trial(info, parts);
        std::vector<std::unique_ptr<StepRecord>> records;
        SceneState refined = state;
        const bool found = in_halves(refined, 1, parts, record != nullptr ? &records : nullptr);
        if (!found) {
            add_trial(parts, info);
            return end;
        }
        info = parts;
        if (record != nullptr) {
            for (std::size_t k = records.size() - 1; k > 0; --k) records[k - 1]->next = std::move(records[k]);
            *record = std::move(*records[0]);
        }
        return refined;
    }

private:
    SceneState attempt(const SceneState& state, int halvings, StepInfo& info, StepRecord* record) {
        Options options = halved(m_options, halvings);
        options.is_substep = halvings > 0;
        SceneState end;
        try {
            end = step_at_once(m_model, options, m_parameters, state, m_control, m_workspace, info, record);
        } catch (const PenetratingStart& start) {
            if (halvings == 0) throw;  // the caller's state; else one of ours
            end = hold(state, StepStatus::bad_start, {start.a}, info, record);
        }
        if (!info.converged) ++m_failures;
        return end;
    }

    /// Two steps from `state`, which they move, each so often halved. `info` and `records` are added to.
    bool in_halves(SceneState& state, int halvings, StepInfo& info, std::vector<std::unique_ptr<StepRecord>>* records) {
        for (int half = 0; half < 2; ++half) {
            std::unique_ptr<StepRecord> record = records != nullptr ? std::make_unique<StepRecord>() : nullptr;
            StepInfo now;
            SceneState end = attempt(state, halvings, now, record.get());
            if (now.converged) {
                state = std::move(end);
                add_part(now, info);
                if (records == nullptr) continue;
                record->halvings = halvings;
                records->push_back(std::move(record));
                continue;
            }
            add_trial(now, info);
            if (!is_given_up(now) || halvings == kMaxHalvings || m_failures >= kMaxFailures) return false;
            if (!in_halves(state, halvings + 1, info, records)) return false;
        }
        return true;
    }

    const Model& m_model;
    const Options& m_options;
    const Parameters& m_parameters;
    const SceneControl& m_control;
    StepWorkspace& m_workspace;
    int m_failures = 0;
};

}  // namespace

SceneState step(
    const Model& model, const Options& options, const Parameters& parameters, const SceneState& state,
    const SceneControl& control, StepWorkspace& workspace, StepInfo& info, StepRecord* record) {
    return Refinement(model, options, parameters, control, workspace).run(state, info, record);
}

void step_backward(
    const Model& model, const Options& options, const Parameters& parameters, const SceneControl& control,
    const StepRecord& record, const GradientNeeds& needs, StepWorkspace& workspace, SceneStateGradient& gradient,
    SceneControlGradient& control_gradient, ParameterGradient& parameter_gradient) {
    std::vector<const StepRecord*> parts;
    for (const StepRecord* part = &record; part != nullptr; part = part->next.get()) parts.push_back(part);
    for (std::size_t k = parts.size(); k-- > 0;) {
        GradientNeeds part_needs = needs;
        part_needs.place = needs.place || k > 0;
        backward_at_once(
            model, halved(options, parts[k]->halvings), parameters, control, *parts[k], part_needs, workspace, gradient,
            control_gradient, parameter_gradient);
    }
}

const StepRecord& last_part(const StepRecord& record, Options& options) {
    const StepRecord* part = &record;
    while (part->next) part = part->next.get();
    options = halved(options, part->halvings);
    return *part;
}

}  // namespace diffsim
