// One row of a 3x3 convolution on matrix tiles (AMX): products of bf16, sums in single precision.
//
// Activations are rows [pixel][16] of bf16. Sixteen rows of a tile, 32 bytes apart, are sixteen pixels with the inputs
// of two taps each; the third tap takes a tile half as wide. Gradients are rows of records of 64 bytes: the sixteen values of a pixel interleaved with those of
// the next. A tile of consecutive records is again sixteen pixels with two taps each; a tile of every second record
// is the right-hand operand of the sum over pixels that the weights' gradient is.
#pragma once

#include "convolution_bf16.h"

namespace {

constexpr int gradient_bytes = 4 * filters;
constexpr int tile_pixels = 16, tile_bytes = 1024;

// The compiler does not know that tiles and their configuration are loaded from memory.
inline void fence() { asm volatile("" ::: "memory"); }

// What the tiles are while rows are convolved: 0-3 sums, 4 and 6 two taps' pixels and weights, 5 and 7 one tap's.
// While the weights' gradient is summed up: 0-5 sums, 6 activations, 7 gradients.
template <bool correlating>
class Tiles {
    struct alignas(64) Configuration {
        std::uint8_t palette = 1, start = 0, reserved[14] = {};
        std::uint16_t row_bytes[16] = {64, 64, 64, 64, 64, correlating ? 64 : 32, 64, 64};
        std::uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, correlating ? 16 : 8};
    };

public:
    Tiles() {
        const Configuration all;
        asm volatile("" ::"r"(&all) : "memory");
        _tile_loadconfig(&all);
    }
    ~Tiles() { _tile_release(); }
    Tiles(const Tiles&) = delete;
};

using Setup = Tiles<false>;

// Six tiles: for each row of taps the first two, then the third and nothing. `by_pixel`: a tile's row holds one
// pixel's inputs after the other's, as activations do; else it interleaves them, as gradients do.
template <bool by_pixel>
void pack_tiles(const float* weights, float* packed) {
    char* tile = reinterpret_cast<char*>(packed);
    for (int ky = 0; ky < 3; ++ky)
        for (int pair = 0; pair < 2; ++pair)
            for (int k = 0; k < filters; ++k, tile += 64) {
                const int tap = by_pixel ? k / 8 : 0, c = by_pixel ? 2 * k % filters : k;
                const auto row = [&](int kx, int c) {
                    const bool there = 2 * pair + kx < 3;
                    return there ? _mm512_loadu_ps(weights + ((ky * 3 + 2 * pair + kx) * filters + c) * filters)
                                 : _mm512_setzero_ps();
                };
                _mm512_storeu_si512(tile, by_pixel ? interleaved(row(tap, c), row(tap, c + 1))
                                                   : interleaved(row(0, c), row(1, c)));
            }
    std::memcpy(packed + selfcorrect::layer_weights, weights + selfcorrect::layer_weights, sizeof(float) * filters);
}

void pack(const float* weights, bool of_gradients, float* packed) {
    if (of_gradients) return pack_tiles<false>(weights, packed);
    pack_tiles<true>(weights, packed);
}

// Intrinsics take literal tile numbers only. Gradients' records hold two taps, so their third one comes with nothing.
template <bool four, bool by_pixel>
void convolve_blocks(const char* const* rows, const float* weights, int x, float* out) {
    constexpr int pixel = by_pixel ? activation_bytes : gradient_bytes, next = tile_pixels * pixel;
    const float* bias = weights + selfcorrect::layer_weights;
    const char* tiles = reinterpret_cast<const char*>(weights);
    _tile_loadd(0, bias, 0);
    if (four) {
        _tile_loadd(1, bias, 0);
        _tile_loadd(2, bias, 0);
        _tile_loadd(3, bias, 0);
    }
    for (int ky = 0; ky < 3; ++ky, tiles += 2 * tile_bytes) {
        const char* in = rows[ky] + std::int64_t(x - 1) * pixel;
        _tile_loadd(6, tiles, 64);
        _tile_loadd(4, in, pixel);
        _tile_dpbf16ps(0, 4, 6);
        if (four) {
            _tile_loadd(4, in + next, pixel);
            _tile_dpbf16ps(1, 4, 6);
            _tile_loadd(4, in + 2 * next, pixel);
            _tile_dpbf16ps(2, 4, 6);
            _tile_loadd(4, in + 3 * next, pixel);
            _tile_dpbf16ps(3, 4, 6);
        }
        in += 2 * pixel;
        if (by_pixel) {
            _tile_loadd(7, tiles + tile_bytes, 64);
            _tile_loadd(5, in, pixel);
            _tile_dpbf16ps(0, 5, 7);
            if (four) {
                _tile_loadd(5, in + next, pixel);
                _tile_dpbf16ps(1, 5, 7);
                _tile_loadd(5, in + 2 * next, pixel);
                _tile_dpbf16ps(2, 5, 7);
                _tile_loadd(5, in + 3 * next, pixel);
                _tile_dpbf16ps(3, 5, 7);
            }
        } else {
            _tile_loadd(6, tiles + tile_bytes, 64);
            _tile_loadd(4, in, pixel);
            _tile_dpbf16ps(0, 4, 6);
            if (four) {
                _tile_loadd(4, in + next, pixel);
                _tile_dpbf16ps(1, 4, 6);
                _tile_loadd(4, in + 2 * next, pixel);
                _tile_dpbf16ps(2, 4, 6);
                _tile_loadd(4, in + 3 * next, pixel);
                _tile_dpbf16ps(3, 4, 6);
            }
        }
    }
    _tile_stored(0, out, 64);
    if (four) {
        _tile_stored(1, out + tile_pixels * filters, 64);
        _tile_stored(2, out + 2 * tile_pixels * filters, 64);
        _tile_stored(3, out + 3 * tile_pixels * filters, 64);
    }
}

template <bool by_pixel>
void convolve(const char* const* rows, int, const float* weights, int width, float* out) {
    fence();
    int x = 0;
    for (; x + 3 * tile_pixels < width; x += 4 * tile_pixels)
        convolve_blocks<true, by_pixel>(rows, weights, x, out + x * filters);
    for (; x < width; x += tile_pixels) convolve_blocks<false, by_pixel>(rows, weights, x, out + x * filters);
}

// Zero where the activation was; the layer's bias gradient on the way.
void keep_gradient(const float* line, int width, const char* activation, char* row, float* bias) {
    __m512 sum = _mm512_setzero_ps(), before = sum;
    for (int x = 0; x < width; ++x) {
        __mmask16 active = 0xffff;
        if (activation) {
            const __m256i values = _mm256_loadu_si256((const __m256i*)(activation + x * activation_bytes));
            active = _mm256_cmpgt_epi16_mask(values, _mm256_setzero_si256());  // bf16 > 0 exactly where its bits are
        }
        const __m512 here = _mm512_maskz_loadu_ps(active, line + x * filters);
        sum = _mm512_add_ps(sum, here);
        _mm512_storeu_si512(row + (x - 1) * gradient_bytes, interleaved(before, here));
        before = here;
    }
    _mm512_storeu_si512(row + (width - 1) * gradient_bytes, interleaved(before, _mm512_setzero_ps()));
    clear(row, -border, -1, gradient_bytes);
    clear(row, width, selfcorrect::row_pixels(width) - border, gradient_bytes);
    _mm512_storeu_ps(bias, _mm512_add_ps(_mm512_loadu_ps(bias), sum));
}

// Sums over all pixels of activation x gradient, for the taps of two rows or one.
template <bool two, class Rows>
void correlate(const char* planes, const Rows& upstream, int ky, int height, int width, float* gradient) {
    const std::int64_t pitch = 2 * padded(width);
    fence();
    float* const first = gradient + ky * 3 * filters * filters;
    constexpr int tile = filters * filters;
    _tile_loadd(0, first, 64);
    _tile_loadd(1, first + tile, 64);
    _tile_loadd(2, first + 2 * tile, 64);
    if (two) {
        _tile_loadd(3, first + 3 * tile, 64);
        _tile_loadd(4, first + 4 * tile, 64);
        _tile_loadd(5, first + 5 * tile, 64);
    }
    for (int y = 0; y < height; ++y) {
        const char* rows[2] = {upstream(y + 1 - ky), two ? upstream(y - ky) : nullptr};
        for (int x = 0; x < width; x += 32) {
            _tile_loadd(6, planes + y * filters * pitch + 2 * x, pitch);
            const char* p = rows[0] + x * gradient_bytes;
            _tile_loadd(7, p + gradient_bytes, 2 * gradient_bytes);
            _tile_dpbf16ps(0, 6, 7);
            _tile_loadd(7, p, 2 * gradient_bytes);
            _tile_dpbf16ps(1, 6, 7);
            _tile_loadd(7, p - gradient_bytes, 2 * gradient_bytes);
            _tile_dpbf16ps(2, 6, 7);
            if (two) {
                p = rows[1] + x * gradient_bytes;
                _tile_loadd(7, p + gradient_bytes, 2 * gradient_bytes);
                _tile_dpbf16ps(3, 6, 7);
                _tile_loadd(7, p, 2 * gradient_bytes);
                _tile_dpbf16ps(4, 6, 7);
                _tile_loadd(7, p - gradient_bytes, 2 * gradient_bytes);
                _tile_dpbf16ps(5, 6, 7);
            }
        }
    }
    _tile_stored(0, first, 64);
    _tile_stored(1, first + tile, 64);
    _tile_stored(2, first + 2 * tile, 64);
    if (two) {
        _tile_stored(3, first + 3 * tile, 64);
        _tile_stored(4, first + 4 * tile, 64);
        _tile_stored(5, first + 5 * tile, 64);
    }
}

double peak(std::int64_t rounds) {
    const Setup setup;
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
    _tile_zero(4);
    _tile_zero(6);
    for (std::int64_t i = 0; i < rounds; ++i) {
        _tile_dpbf16ps(0, 4, 6);
        _tile_dpbf16ps(1, 4, 6);
        _tile_dpbf16ps(2, 4, 6);
        _tile_dpbf16ps(3, 4, 6);
    }
    return double(rounds) * 4 * tile_pixels * filters * 2 * filters;
}

template <class Rows>
void weight_gradient(const Rows& activation, const Rows& upstream, int, int height, int width, float* gradient,
                     char* scratch) {
    make_planes(activation, height, width, scratch);
    const Tiles<true> tiles;
    correlate<true>(scratch, upstream, 0, height, width, gradient);
    correlate<false>(scratch, upstream, 2, height, width, gradient);
}

}  // namespace
