// 16 x 16 floats turned over: between planes and pixels.
#pragma once

#include "simd.h"

namespace {

inline void transpose(const float* from, float* to) {
#if defined(__AVX512F__)
    __m512 a[16], b[16];
    for (int i = 0; i < 16; ++i) a[i] = _mm512_loadu_ps(from + 16 * i);
    for (int i = 0; i < 16; i += 2) {
        b[i] = _mm512_unpacklo_ps(a[i], a[i + 1]);
        b[i + 1] = _mm512_unpackhi_ps(a[i], a[i + 1]);
    }
    for (int i = 0; i < 16; i += 4)
        for (int k = 0; k < 2; ++k) {
            const __m512d low = (__m512d)b[i + k], high = (__m512d)b[i + 2 + k];
            a[i + 2 * k] = (__m512)_mm512_unpacklo_pd(low, high);
            a[i + 2 * k + 1] = (__m512)_mm512_unpackhi_pd(low, high);
        }
    // Now a[4i + k] holds columns k, k + 4, k + 8, k + 12 of rows 4i .. 4i + 3.
    for (int k = 0; k < 4; ++k) {
        b[k] = _mm512_shuffle_f32x4(a[k], a[4 + k], 0x88);
        b[4 + k] = _mm512_shuffle_f32x4(a[k], a[4 + k], 0xdd);
        b[8 + k] = _mm512_shuffle_f32x4(a[8 + k], a[12 + k], 0x88);
        b[12 + k] = _mm512_shuffle_f32x4(a[8 + k], a[12 + k], 0xdd);
    }
    for (int k = 0; k < 4; ++k) {
        _mm512_storeu_ps(to + 16 * k, _mm512_shuffle_f32x4(b[k], b[8 + k], 0x88));
        _mm512_storeu_ps(to + 16 * (8 + k), _mm512_shuffle_f32x4(b[k], b[8 + k], 0xdd));
        _mm512_storeu_ps(to + 16 * (4 + k), _mm512_shuffle_f32x4(b[4 + k], b[12 + k], 0x88));
        _mm512_storeu_ps(to + 16 * (12 + k), _mm512_shuffle_f32x4(b[4 + k], b[12 + k], 0xdd));
    }
#else
    for (int i = 0; i < 16; ++i)
        for (int k = 0; k < 16; ++k) to[16 * k + i] = from[16 * i + k];
#endif
}

}  // namespace
