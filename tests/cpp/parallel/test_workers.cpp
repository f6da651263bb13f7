#include "parallel/interrupt.hpp"
#include "parallel/workers.hpp"

#include <chrono>
#include <numeric>
#include <stdexcept>
#include <string>

#include "check.hpp"

namespace test_workers {

using namespace diffsim;

namespace {

TEST(workers_call_every_index_once) {
    for (const int threads : {1, 2, 5}) {
        Workers workers(threads);
        for (const int count : {0, 1, 7, 8, 9, 1000}) {
            NOTE(threads);
            NOTE(count);
            std::vector<int> calls(static_cast<std::size_t>(count), 0);
            std::vector<char> range_fits(static_cast<std::size_t>(count), 0);
            workers.for_each_range(count, 8, [&](int begin, int end, int thread) {
                for (int i = begin; i < end; ++i) {
                    ++calls[i];
                    range_fits[i] = (threads == 1 || end - begin <= 8) && thread >= 0 && thread < threads;
                }
            });
            for (int i = 0; i < count; ++i) {
                CHECK(calls[i] == 1);
                CHECK(range_fits[i] != 0);
            }
        }
    }
}

TEST(workers_finish_a_loop_before_the_next_begins) {
    Workers workers(3);
    std::vector<int> values(100, 0);
    constexpr int kLoops = 2000;
    for (int loop = 0; loop < kLoops; ++loop) {
        workers.for_each_range(100, 5, [&](int begin, int end, int) {
            for (int i = begin; i < end; ++i) ++values[i];
        });
        // What lies between loops is now and then long enough for the others to fall asleep.
        if (loop % 500 == 0) std::this_thread::sleep_for(std::chrono::milliseconds(2));
        CHECK(std::accumulate(values.begin(), values.end(), 0) == 100 * (loop + 1));
    }
}

TEST(workers_share_a_loop) {
    Workers workers(2);
    std::atomic<int> arrived{0};
    // Each range waits for the other: one thread alone would wait for ever.
    workers.for_each_range(2, 1, [&](int, int, int) {
        ++arrived;
        while (arrived < 2) std::this_thread::yield();
    });
    CHECK(arrived == 2);
}

TEST(workers_do_small_loops_on_the_owners_thread) {
    Workers workers(4);
    std::thread::id id;
    workers.for_each_range(8, 8, [&](int, int, int) { id = std::this_thread::get_id(); });
    CHECK(id == std::this_thread::get_id());
}

TEST(workers_end_each_on_its_own_thread) {
    std::thread::id worked, ended;
    std::atomic<int> ends{0};
    {
        Workers workers(2, [&](int thread) {
            CHECK(thread == 1);
            ended = std::this_thread::get_id();
            ++ends;
        });
        std::atomic<int> arrived{0};
        workers.for_each_range(2, 1, [&](int, int, int thread) {
            if (thread == 1) worked = std::this_thread::get_id();
            ++arrived;
            while (arrived < 2) std::this_thread::yield();
        });
        CHECK(ends == 0);
    }
    CHECK(ends == 1);
    CHECK(ended == worked);
    CHECK(ended != std::this_thread::get_id());
}

TEST(workers_throw_what_the_first_range_threw) {
    for (const int threads : {1, 3}) {
        Workers workers(threads);
        for (int repeat = 0; repeat < 100; ++repeat) {
            std::string caught;
            try {
                workers.for_each_range(40, 1, [&](int begin, int end, int) {
                    for (int i = begin; i < end; ++i)
                        if (i == 11 || i >= 30) throw std::runtime_error(std::to_string(i));
                });
            } catch (const std::runtime_error& error) {
                caught = error.what();
            }
            CHECK(caught == "11");
        }
        int calls = 0;
        workers.for_each_range(1, 1, [&](int, int, int) { ++calls; });
        CHECK(calls == 1);
    }
}

TEST(workers_let_a_waiting_owner_look_up) {
    std::atomic<int> looks{0};
    Workers workers(2, nullptr, [&] { ++looks; });
    std::atomic<int> arrived{0};
    // The other thread's range ends only when the owner, which is done with its own, has looked up.
    workers.for_each_range(2, 1, [&](int, int, int thread) {
        ++arrived;
        while (arrived < 2) std::this_thread::yield();
        if (thread != 0)
            while (looks < 2) std::this_thread::yield();
    });
    CHECK(looks >= 2);
}

TEST(interrupt_is_polled_by_its_maker_alone_and_seen_by_all) {
    std::atomic<int> polls{0};
    std::atomic<bool> wanted{false};
    const std::thread::id maker = std::this_thread::get_id();
    bool by_maker = true;
    Interrupt interrupt([&] {
        ++polls;
        by_maker = by_maker && std::this_thread::get_id() == maker;
        return wanted.load();
    });
    std::atomic<bool> seen{false};
    std::thread other([&] {
        while (!interrupt.asked()) std::this_thread::yield();
        seen = true;
    });
    while (polls < 2) CHECK(!interrupt.asked());
    wanted = true;
    while (!interrupt.asked()) std::this_thread::yield();
    other.join();
    CHECK(seen);
    CHECK(by_maker);
    CHECK_THROWS(interrupt.throw_if_asked(), Interrupted);
}

}  // namespace

}  // namespace test_workers
