// What bfloat16 variants have in common: activations are rows [pixel][16] of bf16, products are of bf16 and sums in single
// precision.
#pragma once

#include <immintrin.h>

#include "convolution.h"
#include "simd.h"
#include "transpose.h"

namespace {

using selfcorrect::border;
using selfcorrect::filters;

constexpr int activation_bytes = 2 * filters;

// A vector of a0 … a15, b0 … b15 as a0, b0, a1, b1, …
inline __m512i shuffled(__m512i both) {
    const __m512i order = _mm512_set_epi16(31, 15, 30, 14, 29, 13, 28, 12, 27, 11, 26, 10, 25, 9, 24, 8,  //
                                           23, 7, 22, 6, 21, 5, 20, 4, 19, 3, 18, 2, 17, 1, 16, 0);
    return _mm512_permutexvar_epi16(order, both);
}

// Pairs of 32-bit halves (a of one vector, b of the other) as bf16, a below b.
inline __m512i interleaved(__m512 a, __m512 b) { return shuffled((__m512i)_mm512_cvtne2ps_pbh(b, a)); }

void clear(char* row, std::int64_t from, std::int64_t to, int bytes) {
    std::memset(row + from * bytes, 0, (to - from) * bytes);
}

void keep_activation(const float* line, int width, bool relu, char* row) {
    const __m512 least = _mm512_set1_ps(relu ? 0.0f : -__builtin_inff());
    for (int x = 0; x < width; x += 2) {  // an odd width's last pair reaches into the line's slack
        const __m512 here = _mm512_max_ps(_mm512_loadu_ps(line + x * filters), least);
        const __m512 next = _mm512_max_ps(_mm512_loadu_ps(line + (x + 1) * filters), least);
        _mm512_storeu_si512(row + x * activation_bytes, (__m512i)_mm512_cvtne2ps_pbh(next, here));
    }
    clear(row, -border, 0, activation_bytes);
    clear(row, width, selfcorrect::row_pixels(width) - border, activation_bytes);
}

constexpr std::int64_t padded(int width) { return selfcorrect::row_pixels(width) - 2 * border; }

constexpr std::int64_t weight_scratch(int height, int width) {
    return height * padded(width) * activation_bytes;
}

// Thirty-two pixels [pixel][16] to [16][pixel], both bf16; the rows of `to` are `pitch` bytes apart.
inline void transpose_pixels(const char* from, char* to, std::int64_t pitch) {
    float pairs[16 * 16], planes[16 * 16];
    for (int i = 0; i < 16; ++i)
        _mm512_storeu_si512(pairs + 16 * i, shuffled(_mm512_loadu_si512(from + 64 * i)));
    transpose(pairs, planes);
    for (int c = 0; c < 16; ++c) _mm512_storeu_si512(to + c * pitch, _mm512_loadu_si512(planes + 16 * c));
}

// All activations as planes, [row][channel][pixel].
template <class Rows>
void make_planes(const Rows& activation, int height, int width, char* planes) {
    const std::int64_t pitch = 2 * padded(width);
    for (int y = 0; y < height; ++y)
        for (int x = 0; x < width; x += 32)
            transpose_pixels(activation(y) + x * activation_bytes, planes + y * filters * pitch + 2 * x, pitch);
}

}  // namespace
