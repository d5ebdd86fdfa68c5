// What this processor can run, and how work is spread over its threads.
#pragma once

#include <atomic>
#include <cstdint>
#include <thread>
#include <vector>

#if defined(SELFCORRECT_X86)
#include <xmmintrin.h>
#endif

namespace selfcorrect {

// Denormals contribute nothing and cost a hundred cycles each.
class FlushDenormals {
#if defined(SELFCORRECT_X86)
    unsigned saved = _mm_getcsr();

public:
    FlushDenormals() { _mm_setcsr(saved | 0x8040); }
    ~FlushDenormals() { _mm_setcsr(saved); }
#endif
};

// Calls work(task, worker) for each task in [0, tasks), at most `threads` at a time, each on a worker of its own.
template <class Work>
void spread(std::int64_t tasks, int threads, const Work& work) {
    std::atomic<std::int64_t> next{0};
    const auto run = [&](int worker) {
        const FlushDenormals flush;
        for (std::int64_t task = next++; task < tasks; task = next++) work(task, worker);
    };
    std::vector<std::thread> pool;
    for (int worker = 1; worker < threads && worker < tasks; ++worker) pool.emplace_back(run, worker);
    run(0);
    for (auto& thread : pool) thread.join();
}

}  // namespace selfcorrect
