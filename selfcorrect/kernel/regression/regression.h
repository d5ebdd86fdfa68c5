// What one call of the windowed regression works on. Pointers are borrowed from the caller for the length of the call.
#pragma once

#include <cstdint>

namespace selfcorrect {

// Models are solved at every `stride`-th pixel of every `stride`-th row: the centres. The image is cut into cells of
// stride x stride pixels whose first pixel is the centre, and a plane into stride^2 planes, one for each place in the
// cell, so that neighbouring centres, and the taps they read, are neighbours in memory.
struct Regression {
    // (stride^2, channels, rows, columns), padded by `margin` cells: features, then 3 targets.
    const float* planes;
    std::int64_t place_stride, plane_stride, row_stride;
    int vectors, scalars;  // features: so many groups of three, then so many single ones
    int radius, stride, margin;
    int height, width;  // cells
    float ridge;
    float inverse_bandwidth;  // weight = 2^(-inverse_bandwidth |first group's difference|^2), where `weights` is null
    const float* weights;     // else (taps, weight_rows, weight_columns), of the rows from first_row on; stride 1 only
    std::int64_t weight_rows, weight_columns;
    int first_row;

    // solve: (3 (features + 1), height, width): for each channel the value at the centre, then the slopes.
    float* models;
    // reconstruct: the models and then the centres' features, padded like the planes; output (stride^2, 3, height, width).
    const float* centres;
    std::int64_t centre_plane_stride, centre_row_stride;
    float* output;
};

using RegressionRow = void (*)(const Regression&, std::int64_t row, float* scratch);

constexpr int largest_features = 11;
constexpr int regression_chunk = 13;  // taps whose features and products stay in the first-level cache
constexpr std::int64_t regression_scratch =
    16LL * ((2 * largest_features + 5) * regression_chunk + (largest_features + 1) * (largest_features + 4));

void solve_avx512(const Regression&, std::int64_t, float*);
void solve_avx2(const Regression&, std::int64_t, float*);
void solve_baseline(const Regression&, std::int64_t, float*);
void reconstruct_avx512(const Regression&, std::int64_t, float*);
void reconstruct_avx2(const Regression&, std::int64_t, float*);
void reconstruct_baseline(const Regression&, std::int64_t, float*);

}  // namespace selfcorrect
