// One row of a 3x3 convolution in single precision. Rows are [pixel][16]; blocks of pixels and one vector of outputs
// stay in registers, and each input value is loaded once for the three taps of its row.
#pragma once

#include "convolution.h"
#include "simd.h"

namespace {

using selfcorrect::filters;

constexpr int activation_bytes = 4 * filters, gradient_bytes = 4 * filters;
constexpr int block = lanes == 16 ? 16 : 8;           // pixels in registers
constexpr int channel_group = lanes == 16 ? 8 : 4;    // inputs whose three taps' gradients are in registers

struct Setup {};  // nothing to switch on

inline const float* pixels(const char* row) { return reinterpret_cast<const float*>(row); }

void pack(const float* weights, bool, float* packed) {
    std::memcpy(packed, weights, sizeof(float) * selfcorrect::layer_floats);
}

inline void convolve_block(const char* const* rows, int inputs, const float* weights, int x, float* out) {
    Float sum[block];
    for (int p = 0; p < block; ++p) sum[p] = load(weights + selfcorrect::layer_weights);
    for (int ky = 0; ky < 3; ++ky) {
        const float* in = pixels(rows[ky]) + (x - 1) * filters;
        const float* w = weights + ky * 3 * filters * filters;
        for (int c = 0; c < inputs; ++c, ++in, w += filters) {
            const Float left = load(w), middle = load(w + filters * filters), right = load(w + 2 * filters * filters);
#pragma GCC unroll 18
            for (int q = -1; q <= block; ++q) {
                const Float value = splat(in[(q + 1) * filters]);
                if (q + 1 < block) sum[q + 1] += value * left;
                if (q >= 0 && q < block) sum[q] += value * middle;
                if (q >= 1) sum[q - 1] += value * right;
            }
        }
    }
    for (int p = 0; p < block; ++p) store(out + p * filters, sum[p]);
}

template <bool by_pixel>  // gradients lie as activations do
void convolve(const char* const* rows, int inputs, const float* weights, int width, float* out) {
    for (int x = 0; x < width; x += block)
        for (int o = 0; o < filters; o += lanes) convolve_block(rows, inputs, weights + o, x, out + x * filters + o);
}

void clear_borders(char* row, int width) {
    std::memset(row - selfcorrect::border * activation_bytes, 0, selfcorrect::border * activation_bytes);
    const std::int64_t end = selfcorrect::row_pixels(width) - selfcorrect::border;
    std::memset(row + width * activation_bytes, 0, (end - width) * activation_bytes);
}

void keep_activation(const float* line, int width, bool relu, char* row) {
    float* out = reinterpret_cast<float*>(row);
    const Float least = splat(relu ? 0.0f : -__builtin_inff());
    for (int i = 0; i < width * filters; i += lanes) store(out + i, maximum(load(line + i), least));
    clear_borders(row, width);
}

// Zero where the activation was; the layer's bias gradient on the way.
void keep_gradient(const float* line, int width, const char* activation, char* row, float* bias) {
    float* out = reinterpret_cast<float*>(row);
    for (int o = 0; o < filters; o += lanes) {
        Float sum = {};
        for (int i = o; i < width * filters; i += filters) {
            Float value = load(line + i);
            if (activation) value = load(pixels(activation) + i) > 0.0f ? value : Float{};
            store(out + i, value);
            sum += value;
        }
        store(bias + o, load(bias + o) + sum);
    }
    clear_borders(row, width);
}

// Of activations (channels c .. c + channel_group - 1) at one row with the gradients of the row that sees it through ky.
inline void correlate(const float* in, const float* upstream, int width, float* gradient) {
    Float sum[3][channel_group] = {};
    Float before = load(upstream - filters), here = load(upstream);
    for (int x = 0; x < width; ++x) {
        const Float after = load(upstream + (x + 1) * filters);
#pragma GCC unroll 8
        for (int c = 0; c < channel_group; ++c) {
            const Float value = splat(in[x * filters + c]);
            sum[0][c] += value * after;
            sum[1][c] += value * here;
            sum[2][c] += value * before;
        }
        before = here;
        here = after;
    }
    for (int kx = 0; kx < 3; ++kx)
        for (int c = 0; c < channel_group; ++c) {
            float* p = gradient + (kx * filters + c) * filters;
            store(p, load(p) + sum[kx][c]);
        }
}

constexpr std::int64_t weight_scratch(int, int) { return 0; }

double peak(std::int64_t rounds) {
    constexpr int sums = 12;
    Float sum[sums];
    for (int k = 0; k < sums; ++k) sum[k] = splat(float(k));  // all different, or the compiler would do one only
    const Float factor = splat(0.5f);
    for (std::int64_t i = 0; i < rounds; ++i) {
#pragma GCC unroll 12
        for (int k = 0; k < sums; ++k) sum[k] = sum[k] * factor + factor;
    }
    volatile Float kept;
    for (int k = 0; k < sums; ++k) kept = sum[k];
    return double(rounds) * sums * lanes;
}

template <class Rows>
void weight_gradient(const Rows& activation, const Rows& upstream, int inputs, int height, int width, float* gradient,
                     char*) {
    for (int y = 0; y < height; ++y)
        for (int ky = 0; ky < 3; ++ky) {
            const int seen_from = y + 1 - ky;
            if (seen_from < 0 || seen_from >= height) continue;
            for (int c = 0; c < inputs; c += channel_group)
                for (int o = 0; o < filters; o += lanes)
                    correlate(pixels(activation(y)) + c, pixels(upstream(seen_from)) + o, width,
                              gradient + (ky * 3 * filters + c) * filters + o);
        }
}

}  // namespace
