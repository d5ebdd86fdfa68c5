// What one call of the kernel works on. Pointers are borrowed from the caller for the length of the call.
#pragma once

#include <cstdint>

#include "terms.h"

namespace selfcorrect {

enum class Mode { forward, backward, loss };

struct Job {
    // Padded guide planes, (channels, height, width), of the terms that the frame has, in the order of their places.
    const float* planes;
    std::int64_t plane_stride, row_stride;
    unsigned present;  // bit m: the m-th of `terms`
    bool eq3;  // Eq. 3: beta^z = 1, no other beta; else Eq. 10
    int window;
    int every;  // taps taken: all with 1, else those of a lattice, one in `every`

    // Raw network outputs and their gradient, (patches, heads, h, w) with any strides.
    const float* heads;
    float* heads_gradient;
    std::int64_t head_strides[4], gradient_strides[4];
    int patches, height, width;
    const std::int64_t* corners;  // (patches, 2): row and column of each patch's first pixel in the padded planes

    float* output;                 // forward: g, (patches, 3, h, w), contiguous
    const float* output_gradient;  // backward: dL/dg, the same shape

    // loss: other half's radiance (3 planes) and its weight (1 plane), padded like `planes`; one sum per patch row.
    const float* target;
    const float* weight;
    double* row_loss;
};

// Each works on patch row `row` in [0, patches * height); `scratch` holds scratch_size(window) floats.
using RowFunction = void (*)(const Job&, Mode, std::int64_t row, float* scratch);

// What is kept of every tap, at the widest vector; plus room to align.
constexpr std::int64_t scratch_size(int window) { return std::int64_t(most_kept) * window * window * 16 + 16; }

void row_avx512(const Job&, Mode, std::int64_t, float*);
void row_avx2(const Job&, Mode, std::int64_t, float*);
void row_baseline(const Job&, Mode, std::int64_t, float*);

}  // namespace selfcorrect
