#pragma once

#include <algorithm>
#include <memory>
#include <vector>

#include "step/step.hpp"

namespace diffsim {

/// From how many bodies and nodes on threads are better used inside a scene than left idle for want of scenes.
inline constexpr int kBigScene = 256;

/// Call work(scene, workspace) for every scene. Threads divide the scenes among themselves where there is one for each
/// of them, else, where scenes are big, the bodies and zones of one scene after the other. The first exception, by
/// scene, is thrown on. `interrupt`, if given, is asked while the calling thread has nothing else to do.
template <typename Work>
void for_each_scene(const Model& model, int batch, int thread_count, Interrupt* interrupt, const Work& work) {
    const bool one_by_one =
        batch < thread_count && (batch == 1 || model.body_count() + model.node_count() >= kBigScene);
    const int scene_threads = one_by_one ? 1 : std::min(batch, thread_count);
    // Each thread makes its own and gives it back; see StepWorkspace::memory.
    std::vector<std::unique_ptr<StepWorkspace>> workspaces(static_cast<std::size_t>(scene_threads));
    const auto while_waiting = [&] {
        if (interrupt != nullptr) interrupt->asked();
    };
    Workers workers(scene_threads, [&](int thread) { workspaces[thread].reset(); }, while_waiting);
    workers.for_each_range(batch, 1, [&](int begin, int end, int thread) {
        std::unique_ptr<StepWorkspace>& workspace = workspaces[thread];
        if (!workspace) workspace = std::make_unique<StepWorkspace>(one_by_one ? thread_count : 1);
        workspace->interrupt = interrupt;
        for (int scene = begin; scene < end; ++scene) work(scene, *workspace);
    });
}

}  // namespace diffsim
