#pragma once

#include <atomic>
#include <condition_variable>
#include <cstdint>
#include <exception>
#include <functional>
#include <mutex>
#include <thread>
#include <utility>
#include <vector>

namespace diffsim {

/// Threads that take part in the loops of the one that owns them.
///
/// None is started before the first loop worth sharing. Between loops they look for the next one for a moment and then
/// sleep, and a loop never waits for one to wake up: whoever is awake takes the next range.
class Workers {
public:
    /// Each thread but the owner's calls `at_end` with its number before it ends. The owner calls `while_waiting`,
    /// which must not throw, now and then while it waits for the others at the end of a loop.
    explicit Workers(
        int thread_count, std::function<void(int thread)> at_end = nullptr,
        std::function<void()> while_waiting = nullptr)
        : m_thread_count(thread_count), m_at_end(std::move(at_end)), m_while_waiting(std::move(while_waiting)) {}
    ~Workers();
    Workers(const Workers&) = delete;
    Workers& operator=(const Workers&) = delete;

    /// How many threads loops run on, the owner's included.
    int thread_count() const { return m_thread_count; }

    /// Call work(begin, end, thread) for ranges of at most `grain` that make up [0, count), and return when all are
    /// done. The owner takes ranges from the front and the others from the back, so that a thread mostly meets in one
    /// loop the items that it had in the last, whose memory is near it; where they meet is left to chance. Throws the
    /// exception of the first range that threw one.
    template <class Work>
    void for_each_range(int count, int grain, const Work& work) {
        if (m_thread_count > 1 && count > grain) {
            share(count, grain, &work, [](const void* object, int begin, int end, int thread) {
                (*static_cast<const Work*>(object))(begin, end, thread);
            });
        } else if (count > 0) {
            work(0, count, 0);
        }
    }

private:
    using Call = void (*)(const void* work, int begin, int end, int thread);

    void share(int count, int grain, const void* work, Call call);
    void start();
    void serve(int thread);
    void run_ranges(int thread);
    int claim_range(int thread);
    bool any_unclaimed() const;
    template <class Ready>
    void wait_until(const Ready& ready, const std::function<void()>& while_waiting = nullptr);
    void wake();

    int m_thread_count;
    std::function<void(int thread)> m_at_end;
    std::function<void()> m_while_waiting;
    std::vector<std::thread> m_threads;

    // The loop at hand. Read by those alone who have claimed one of its ranges and not yet finished it.
    const void* m_work = nullptr;
    Call m_call = nullptr;
    int m_count = 0, m_grain = 0;
    std::atomic<std::uint64_t> m_unclaimed{0};  ///< ranges: the first of them, and 32 bits lower the end
    std::atomic<int> m_unfinished{0};           ///< ranges

    int m_first_error = 0;  ///< the range that threw m_error
    std::exception_ptr m_error;

    std::mutex m_mutex;  ///< of the errors, and for sleeping
    std::condition_variable m_changed;
    std::atomic<int> m_sleeping{0};
    std::atomic<bool> m_stopping{false};
};

}  // namespace diffsim
