// One row of a 3x3 convolution where a processor multiplies pairs of bf16 (AVX512-BF16). Gradients are rows of pixels as
// activations are. A vector of weights is sixteen outputs with two inputs each, and the same two of a pixel go with all.
#pragma once

#include "convolution_bf16.h"

namespace {

constexpr int gradient_bytes = activation_bytes;
constexpr int block = 16;         // pixels in registers
constexpr int channel_group = 8;  // inputs whose three taps' gradients are in registers
constexpr int pair_bytes = 4, vector_bytes = 64;

struct Setup {};  // nothing to switch on

inline __m512 plus_products(__m512 sum, __m512i a, __m512i b) { return _mm512_dpbf16_ps(sum, (__m512bh)a, (__m512bh)b); }

inline __m512i everywhere(const char* pair) {
    std::int32_t bits;
    std::memcpy(&bits, pair, sizeof bits);
    return _mm512_set1_epi32(bits);
}

// [ky][pair of inputs][kx].
void pack(const float* weights, bool, float* packed) {
    char* to = reinterpret_cast<char*>(packed);
    for (int ky = 0; ky < 3; ++ky)
        for (int c = 0; c < filters; c += 2)
            for (int kx = 0; kx < 3; ++kx, to += vector_bytes) {
                const float* from = weights + ((ky * 3 + kx) * filters + c) * filters;
                _mm512_storeu_si512(to, interleaved(_mm512_loadu_ps(from), _mm512_loadu_ps(from + filters)));
            }
    std::memcpy(packed + selfcorrect::layer_weights, weights + selfcorrect::layer_weights, sizeof(float) * filters);
}

inline void convolve_block(const char* const* rows, int inputs, const float* weights, int x, float* out) {
    __m512 sum[block];
    for (int p = 0; p < block; ++p) sum[p] = _mm512_loadu_ps(weights + selfcorrect::layer_weights);
    for (int ky = 0; ky < 3; ++ky) {
        const char* in = rows[ky] + std::int64_t(x - 1) * activation_bytes;
        const char* w = reinterpret_cast<const char*>(weights) + ky * 3 * filters / 2 * vector_bytes;
        for (int c = 0; c < inputs; c += 2, in += pair_bytes, w += 3 * vector_bytes) {
            const __m512i left = _mm512_loadu_si512(w), middle = _mm512_loadu_si512(w + vector_bytes),
                          right = _mm512_loadu_si512(w + 2 * vector_bytes);
#pragma GCC unroll 18
            for (int q = -1; q <= block; ++q) {
                const __m512i value = everywhere(in + (q + 1) * activation_bytes);
                if (q + 1 < block) sum[q + 1] = plus_products(sum[q + 1], value, left);
                if (q >= 0 && q < block) sum[q] = plus_products(sum[q], value, middle);
                if (q >= 1) sum[q - 1] = plus_products(sum[q - 1], value, right);
            }
        }
    }
    for (int p = 0; p < block; ++p) _mm512_storeu_ps(out + p * filters, sum[p]);
}

template <bool by_pixel>  // gradients lie as activations do
void convolve(const char* const* rows, int inputs, const float* weights, int width, float* out) {
    for (int x = 0; x < width; x += block) convolve_block(rows, inputs, weights, x, out + x * filters);
}

// Zero where the activation was; the layer's bias gradient on the way.
void keep_gradient(const float* line, int width, const char* activation, char* row, float* bias) {
    __m512 sum = _mm512_setzero_ps();
    const auto gradient = [&](int x) {
        __mmask16 active = x < width ? 0xffff : 0;
        if (activation) {
            const __m256i values = _mm256_loadu_si256((const __m256i*)(activation + x * activation_bytes));
            active &= _mm256_cmpgt_epi16_mask(values, _mm256_setzero_si256());  // bf16 > 0 exactly where its bits are
        }
        const __m512 value = _mm512_maskz_loadu_ps(active, line + x * filters);
        sum = _mm512_add_ps(sum, value);
        return value;
    };
    for (int x = 0; x < width; x += 2) {
        const __m512 here = gradient(x), next = gradient(x + 1);
        _mm512_storeu_si512(row + x * gradient_bytes, (__m512i)_mm512_cvtne2ps_pbh(next, here));
    }
    clear(row, -border, 0, gradient_bytes);
    clear(row, width, selfcorrect::row_pixels(width) - border, gradient_bytes);
    _mm512_storeu_ps(bias, _mm512_add_ps(_mm512_loadu_ps(bias), sum));
}

// Of activations (planes of channels, `pitch` bytes apart) at one row with the gradients of the row that sees it through ky.
inline void correlate(const char* planes, std::int64_t pitch, const char* upstream, int width, float* gradient) {
    __m512 sum[3][channel_group] = {};
    for (int x = 0; x < width; x += 2) {
        __m512i seen[3];  // of both pixels, through each kx
        for (int kx = 0; kx < 3; ++kx)
            seen[kx] = shuffled(_mm512_loadu_si512(upstream + std::int64_t(x + 1 - kx) * gradient_bytes));
#pragma GCC unroll 8
        for (int c = 0; c < channel_group; ++c) {
            const __m512i value = everywhere(planes + c * pitch + 2 * x);
            for (int kx = 0; kx < 3; ++kx) sum[kx][c] = plus_products(sum[kx][c], value, seen[kx]);
        }
    }
    for (int kx = 0; kx < 3; ++kx)
        for (int c = 0; c < channel_group; ++c) {
            float* p = gradient + (kx * filters + c) * filters;
            _mm512_storeu_ps(p, _mm512_add_ps(_mm512_loadu_ps(p), sum[kx][c]));
        }
}

double peak(std::int64_t rounds) {
    constexpr int sums = 12;
    __m512 sum[sums];
    for (int k = 0; k < sums; ++k) sum[k] = _mm512_set1_ps(float(k));  // all different, or the compiler would do one only
    const __m512i factor = _mm512_set1_epi32(0);
    for (std::int64_t i = 0; i < rounds; ++i) {
#pragma GCC unroll 12
        for (int k = 0; k < sums; ++k) sum[k] = plus_products(sum[k], (__m512i)sum[k], factor);
    }
    volatile __m512 kept;
    for (int k = 0; k < sums; ++k) kept = sum[k];
    return double(rounds) * sums * 2 * lanes;
}

template <class Rows>
void weight_gradient(const Rows& activation, const Rows& upstream, int inputs, int height, int width, float* gradient,
                     char* scratch) {
    const std::int64_t pitch = 2 * padded(width);
    make_planes(activation, height, width, scratch);
    for (int y = 0; y < height; ++y)
        for (int ky = 0; ky < 3; ++ky) {
            const int seen_from = y + 1 - ky;
            if (seen_from < 0 || seen_from >= height) continue;
            for (int c = 0; c < inputs; c += channel_group)
                correlate(scratch + (y * filters + c) * pitch, pitch, upstream(seen_from), width,
                          gradient + (ky * 3 * filters + c) * filters);
        }
}

}  // namespace
