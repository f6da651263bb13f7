#pragma once

#include <atomic>
#include <chrono>
#include <exception>
#include <functional>
#include <thread>
#include <utility>

namespace diffsim {

/// What a computation that was told to stop throws.
class Interrupted : public std::exception {};

/// Whether a long computation is to stop before its end, asked by all its threads between pieces of their work.
class Interrupt {
public:
    /// The thread that makes it, and no other, calls poll() every now and then to learn whether to stop.
    explicit Interrupt(std::function<bool()> poll) : m_poll(std::move(poll)) {}
    Interrupt(const Interrupt&) = delete;
    Interrupt& operator=(const Interrupt&) = delete;

    /// For any thread.
    bool asked() {
        if (std::this_thread::get_id() == m_owner) look();
        return m_asked.load(std::memory_order_relaxed);
    }

    void throw_if_asked() {
        if (asked()) throw Interrupted();
    }

private:
    using Clock = std::chrono::steady_clock;
    /// Often enough for who waits for it, and so seldom that what poll() waits for, a lock say, costs nothing.
    static constexpr std::chrono::milliseconds kInterval{20};

    void look() {
        const Clock::time_point now = Clock::now();
        if (now - m_last < kInterval) return;
        m_last = now;
        if (m_poll()) m_asked = true;
    }

    std::function<bool()> m_poll;
    std::thread::id m_owner = std::this_thread::get_id();
    Clock::time_point m_last = Clock::now();
    std::atomic<bool> m_asked{false};
};

}  // namespace diffsim
