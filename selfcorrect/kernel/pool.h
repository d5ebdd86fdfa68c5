// Work spread over threads, for every kernel of the module: rows are independent, so the result does not depend on the
// number of threads.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#if defined(SELFCORRECT_X86)
#include <xmmintrin.h>
#endif

namespace selfcorrect {

// Denormal weights contribute nothing and cost a hundred cycles each.
class FlushDenormals {
#if defined(SELFCORRECT_X86)
    unsigned saved = _mm_getcsr();

public:
    FlushDenormals() { _mm_setcsr(saved | 0x8040); }
    ~FlushDenormals() { _mm_setcsr(saved); }
#endif
};

inline std::vector<std::string> instruction_sets() {
    std::vector<std::string> names{"baseline"};
#if defined(SELFCORRECT_X86)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) names.push_back("avx2");
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
        names.push_back("avx512");
#endif
    return names;
}

// The variant of a function that was compiled for the named instruction set.
template <class Function>
Function variant(const std::string& name, Function baseline, Function avx2, Function avx512) {
    const auto names = instruction_sets();
    if (std::find(names.begin(), names.end(), name) == names.end())
        throw std::invalid_argument("expected an instruction set this processor has, but got " + name);
    return name == "avx512" ? avx512 : name == "avx2" ? avx2 : baseline;
}

#if defined(SELFCORRECT_X86)
#define SELFCORRECT_PICK(name, function) \
    selfcorrect::variant(name, function##_baseline, function##_avx2, function##_avx512)
#else
#define SELFCORRECT_PICK(name, function) \
    selfcorrect::variant(name, function##_baseline, function##_baseline, function##_baseline)
#endif

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

// Calls row(index, scratch) for every index below `rows`; each thread has `scratch_floats` floats of its own.
template <class Row>
void run_rows(std::int64_t rows, int threads, std::int64_t scratch_floats, const Row& row) {
    const std::int64_t workers = std::max<std::int64_t>(std::min<std::int64_t>(threads, rows), 1);
    std::vector<float> scratch(workers * scratch_floats);
    spread(rows, threads, [&](std::int64_t i, int worker) { row(i, scratch.data() + worker * scratch_floats); });
}

}  // namespace selfcorrect
