#include "parallel/workers.hpp"

#include <algorithm>
#include <chrono>
#include <utility>

namespace diffsim {
namespace {

/// How long a thread looks for work before it sleeps: longer than what lies between two loops of a step, and no more
/// than waking it costs a few times over.
constexpr std::chrono::microseconds kPatience{100};

/// How often an owner that waits long looks up.
constexpr std::chrono::milliseconds kGlance{20};

struct Ranges {
    std::uint32_t first, end;

    bool empty() const { return first >= end; }
};

Ranges unpack(std::uint64_t packed) {
    return {static_cast<std::uint32_t>(packed >> 32), static_cast<std::uint32_t>(packed)};
}

std::uint64_t pack(const Ranges& ranges) { return static_cast<std::uint64_t>(ranges.first) << 32 | ranges.end; }

}  // namespace

Workers::~Workers() {
    m_stopping = true;
    wake();
    for (std::thread& thread : m_threads) thread.join();
}

void Workers::start() {
    for (int thread = 1; thread < m_thread_count; ++thread) m_threads.emplace_back([this, thread] { serve(thread); });
}

void Workers::serve(int thread) {
    while (!m_stopping) {
        run_ranges(thread);
        wait_until([this] { return any_unclaimed() || m_stopping; });
    }
    if (m_at_end) m_at_end(thread);
}

void Workers::share(int count, int grain, const void* work, Call call) {
    if (m_threads.empty()) start();
    m_work = work;
    m_call = call;
    m_count = count;
    m_grain = grain;
    const int range_count = (count + grain - 1) / grain;
    m_first_error = range_count;
    m_unfinished = range_count;
    m_unclaimed = pack({0, static_cast<std::uint32_t>(range_count)});  // from here on the loop is everybody's
    wake();
    run_ranges(0);
    wait_until([this] { return m_unfinished == 0; }, m_while_waiting);
    if (m_error) std::rethrow_exception(std::exchange(m_error, nullptr));
}

bool Workers::any_unclaimed() const { return !unpack(m_unclaimed).empty(); }

/// -1 if none is left.
int Workers::claim_range(int thread) {
    std::uint64_t seen = m_unclaimed;
    for (;;) {
        Ranges left = unpack(seen);
        if (left.empty()) return -1;
        const std::uint32_t range = thread == 0 ? left.first++ : --left.end;
        // If this succeeds on a later loop than the one that was seen, then it is one of that loop's ranges.
        if (m_unclaimed.compare_exchange_weak(seen, pack(left))) return static_cast<int>(range);
    }
}

void Workers::run_ranges(int thread) {
    for (int range = claim_range(thread); range >= 0; range = claim_range(thread)) {
        // The loop cannot end before this range is finished.
        const int begin = range * m_grain;
        try {
            m_call(m_work, begin, std::min(begin + m_grain, m_count), thread);
        } catch (...) {
            const std::lock_guard<std::mutex> lock(m_mutex);
            if (range < m_first_error) {
                m_first_error = range;
                m_error = std::current_exception();
            }
        }
        if (--m_unfinished == 0 && thread != 0) wake();  // the owner may be asleep
    }
}

template <class Ready>
void Workers::wait_until(const Ready& ready, const std::function<void()>& while_waiting) {
    using Clock = std::chrono::steady_clock;
    const Clock::time_point give_up = Clock::now() + kPatience;
    do {
        if (ready()) return;
        std::this_thread::yield();
    } while (Clock::now() < give_up);
    std::unique_lock<std::mutex> lock(m_mutex);
    ++m_sleeping;
    if (!while_waiting) {
        m_changed.wait(lock, ready);
    } else {
        while (!m_changed.wait_for(lock, kGlance, ready)) {
            lock.unlock();
            while_waiting();
            lock.lock();
        }
    }
    --m_sleeping;
}

/// What is waited for may have come true. Sleepers announce themselves before they look a last time: either they
/// see it, or they are seen here.
void Workers::wake() {
    if (m_sleeping == 0) return;
    {
        const std::lock_guard<std::mutex> lock(m_mutex);
    }
    m_changed.notify_all();
}

}  // namespace diffsim
