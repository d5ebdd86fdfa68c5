// What one call of the non-local means works on. Pointers are borrowed from the caller for the length of the call.
#pragma once

#include <cstdint>

namespace selfcorrect {

// Weights of the pixels in the windows of a strip of rows, and weighted means with them.
struct NonLocal {
    // (channels, rows, columns), padded by `margin` pixels: guide and its variance, or the values to be averaged.
    const float *guide, *variance, *values;
    std::int64_t plane_stride, row_stride;
    int channels, margin, radius, patch_radius;
    int width, first_row, rows;
    float k_squared;
    float* weights;  // (taps, rows, weight_columns)
    std::int64_t weight_columns;
    float* output;  // (channels, rows, width)
};

using NonLocalItem = void (*)(const NonLocal&, std::int64_t item, float* scratch);

// Sums of distances along rows, for every row that a patch of the strip touches.
inline std::int64_t nlm_scratch(const NonLocal& job) {
    const int more = 2 * job.patch_radius;
    return std::int64_t(job.rows + more + 1) * (job.weight_columns + more + 32);
}

void weigh_avx512(const NonLocal&, std::int64_t tap, float*);
void weigh_avx2(const NonLocal&, std::int64_t tap, float*);
void weigh_baseline(const NonLocal&, std::int64_t tap, float*);
void average_avx512(const NonLocal&, std::int64_t row, float*);
void average_avx2(const NonLocal&, std::int64_t row, float*);
void average_baseline(const NonLocal&, std::int64_t row, float*);

}  // namespace selfcorrect
