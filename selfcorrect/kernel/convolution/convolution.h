// The network's 3x3 convolutions as one job: all layers of one patch at a time. Pointers are borrowed.
#pragma once

#include <cstddef>
#include <cstdint>

namespace selfcorrect {

constexpr int filters = 16;  // of every layer, absent ones are zero: a pixel is one cache line of floats
constexpr int layer_weights = 9 * filters * filters;      // [ky][kx][in][out]
constexpr int layer_floats = layer_weights + filters;     // then the biases
constexpr int border = 2;                                 // pixels of zeros before and after each row

// Pixels that a row takes: up to the next multiple of 32 the widest block may read and write.
constexpr std::int64_t row_pixels(std::int64_t width) { return (width + 31) / 32 * 32 + 2 * border; }

struct Image {
    const float* pixels;
    std::int64_t plane_stride, row_stride;
};

struct ConvolutionJob {
    int layers, inputs, heads;
    bool log_radiance;     // show the network ln(1 + x) of the first and the last three inputs
    const float* packed;   // every layer's weights as the variant packed them
    const Image* images;   // one for each patch, all height x width; zeros around them
    int height, width;

    // Every layer's input for the backward pass, or null: [patch][layer][row_pixels] of a row each.
    char* kept;

    float* output;                     // (patches, heads, bottom - top, right - left) of the region, contiguous
    int top, left, bottom, right;

    const float* upstream;             // dL/d heads, (patches, heads, height, width), unit stride along a row
    std::int64_t upstream_strides[3];
    float* gradients;                  // [patch][layer][layer_floats], zero at first
};

struct Task {
    int patch, top, left, bottom, right;
};

// One instruction set's way.
struct Convolution {
    int pixel_bytes;  // of what is kept
    // One layer, to convolve activations or gradients; packed takes layer_floats, too.
    void (*pack)(const float* weights, bool of_gradients, float* packed);
    std::int64_t (*forward_scratch)(const ConvolutionJob&, int width);
    std::int64_t (*backward_scratch)(const ConvolutionJob&);
    void (*forward)(const ConvolutionJob&, const Task&, char* scratch);
    void (*backward)(const ConvolutionJob&, int patch, char* scratch);
    // As many multiply-adds as the processor can do, for scripts/bench/convolution.py; returns how many.
    double (*peak)(std::int64_t rounds);
};

Convolution convolution_amx();
Convolution convolution_avx512bf16();
Convolution convolution_avx512();
Convolution convolution_avx2();
Convolution convolution_baseline();

}  // namespace selfcorrect
