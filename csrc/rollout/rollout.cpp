#include "rollout/rollout.hpp"

#include <algorithm>
#include <chrono>

#include "rollout/inputs.hpp"
#include "rollout/scenes.hpp"

namespace diffsim {
namespace {

void write_state(const SceneState& state, const TrajectoryArrays<double>& out, int time, int scene, Workers& workers) {
    workers.for_each_range(static_cast<int>(state.bodies.size()), kBodiesARange, [&](int begin, int end, int) {
        const auto write = [&](std::size_t k, auto BodyState::* member) {
            constexpr int size = std::decay_t<decltype(state.bodies[0].*member)>::RowsAtCompileTime;
            double* const rows = out[k].at(time, scene);
            for (int i = begin; i < end; ++i) row<size>(rows, i) = state.bodies[i].*member;
        };
        for_each_input<InputKind::state>(write, [](std::size_t, std::vector<Vec3> SceneState::*) {});
    });
    const auto write_nodes = [&](std::size_t k, std::vector<Vec3> SceneState::* member) {
        for (int i = 0; i < static_cast<int>(state.node_position.size()); ++i)
            row<3>(out[k].at(time, scene), i) = (state.*member)[i];
    };
    for_each_input<InputKind::state>(write_nodes, [](std::size_t, auto BodyState::*) {});
}

void merge_info(StepInfo& total, const StepInfo& scene) {
    total.converged = total.converged && scene.converged;
    total.contacts += scene.contacts;
    total.sticking += scene.sticking;
    total.slipping += scene.slipping;
    total.zones += scene.zones;
    total.largest_zone = std::max(total.largest_zone, scene.largest_zone);
    total.max_compression = std::max(total.max_compression, scene.max_compression);
    total.add_effort(scene);
}

void note_failure(const StepInfo& step, int scene, int time, RolloutInfo& info) {
    ++info.failed_steps;
    if (info.failures.size() < kMaxFailures)
        info.failures.push_back({scene, time, step.status, step.failed_objects, step.iterations, step.residual});
}

/// Of a call from those of its scenes.
RolloutInfo merged(const std::vector<RolloutInfo>& scenes) {
    RolloutInfo total;
    for (const RolloutInfo& info : scenes) {
        total.failed_steps += info.failed_steps;
        total.refined_steps += info.refined_steps;
        total.fast_impacts += info.fast_impacts;
        total.failures.insert(total.failures.end(), info.failures.begin(), info.failures.end());
        total.scenes_converged.push_back(info.failed_steps == 0);
        merge_info(total.last, info.last);
    }
    total.converged = total.failed_steps == 0;
    std::stable_sort(total.failures.begin(), total.failures.end(), [](const FailedStep& a, const FailedStep& b) {
        return a.step < b.step;
    });
    if (total.failures.size() > kMaxFailures) total.failures.resize(kMaxFailures);
    if (!total.failures.empty()) total.status = total.failures.front().status;
    return total;
}

/// Before a forward that is recorded for one.
void refuse_gradient_of_friction(const Options& options, const Parameters& parameters) {
    if (parameters.friction.empty()) return;
    if (options.adjoint != AdjointMode::exact)
        throw std::invalid_argument(
            "adjoint='qr' and 'dense' linearise contact without friction, as the paper does; with friction gradients "
            "take adjoint='exact'");
    if (options.compliance == 0.0)
        throw std::invalid_argument(
            "there are no gradients of friction on hard contacts (compliance=0); give contacts a compliance, 1e-6 say");
}

}  // namespace

std::size_t Tape::bytes() const {
    std::size_t total = sizeof(*this);
    for (const auto& scene : records)
        for (const StepRecord& record : scene) total += record.bytes();
    return total;
}

RolloutInfo rollout(
    const std::shared_ptr<const Model>& model, const Options& options, const RolloutShape& shape,
    const RolloutInputs& inputs, const TrajectoryArrays<double>& trajectory, std::vector<std::uint64_t>& signatures,
    Tape* tape, int thread_count, Interrupt* interrupt) {
    const auto begin = std::chrono::steady_clock::now();
    if (tape != nullptr) {
        tape->model = model;
        tape->options = options;
        tape->shape = shape;
        tape->records.resize(static_cast<std::size_t>(shape.batch));
        for (auto& records : tape->records) records.resize(static_cast<std::size_t>(shape.steps));
    }
    signatures.assign(static_cast<std::size_t>(shape.steps) * static_cast<std::size_t>(shape.batch), 0);
    std::vector<RolloutInfo> infos(static_cast<std::size_t>(shape.batch));
    const auto advance = [&](int scene, StepWorkspace& workspace) {
        SceneState state = read_state(*model, inputs, scene);
        refuse_crossing(*model, state);
        const Parameters parameters = read_parameters(*model, inputs, scene);
        if (tape != nullptr) refuse_gradient_of_friction(options, parameters);
        SceneControl control;
        RolloutInfo& info = infos[scene];
        for (int time = 0; time < shape.steps; ++time) {
            if (interrupt != nullptr) interrupt->throw_if_asked();
            located(shape.controls_have_time, "step", shape.first_step + time, [&] {
                read_control(*model, inputs, time, scene, state, workspace.workers, control);
            });
            StepRecord* record = tape != nullptr ? &tape->records[scene][time] : nullptr;
            try {
                state = step(*model, options, parameters, state, control, workspace, info.last, record);
            } catch (const PenetratingStart& start) {
                if (shape.first_step + time == 0) throw;  // the caller's state, not ours
                std::vector<int> pair = {start.a};
                if (start.b != kGround && start.b != start.a) pair.push_back(start.b);
                std::sort(pair.begin(), pair.end());
                state = hold(state, StepStatus::bad_start, std::move(pair), info.last, record);
            }
            info.fast_impacts += info.last.fast_impacts;
            info.refined_steps += info.last.substeps > 1;
            if (!info.last.converged) note_failure(info.last, scene, shape.first_step + time, info);
            signatures
                [static_cast<std::size_t>(time) * static_cast<std::size_t>(shape.batch) +
                 static_cast<std::size_t>(scene)] = info.last.signature;
            if (shape.keep_time) write_state(state, trajectory, time, scene, workspace.workers);
        }
        if (!shape.keep_time) write_state(state, trajectory, 0, scene, workspace.workers);
    };
    for_each_scene(*model, shape.batch, thread_count, interrupt, [&](int scene, StepWorkspace& workspace) {
        located(shape.batch > 1, "scene", scene, [&] { advance(scene, workspace); });
    });
    RolloutInfo total = merged(infos);
    total.has_batch = shape.has_batch;
    total.seconds = std::chrono::duration<double>(std::chrono::steady_clock::now() - begin).count();
    return total;
}

}  // namespace diffsim
