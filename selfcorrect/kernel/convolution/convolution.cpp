// All layers of the network on one patch, forward and backward. Compiled once per instruction set and precision;
// SELFCORRECT_CONVOLUTION names the entry. As in cross_bilateral.cpp nothing here may leak into a baseline build.
//
// The way forward is a wavefront: each step brings a few more rows into every layer, each layer one row behind the one
// before. So a layer's input need not outlive them unless it is kept for the backward pass (then one step does all), and a
// layer's weights, which do not all fit into the L1 cache at once, are fetched once for several rows. A pixel's sums
// are in the same order wherever it lies: the result does not depend on how the image was cut.

#if defined(SELFCORRECT_AMX)
#include "convolution_amx.h"
#elif defined(SELFCORRECT_DOTS)
#include "convolution_dots.h"
#else
#include "convolution_fp32.h"
#endif
#include "transpose.h"

namespace {

using selfcorrect::border;
using selfcorrect::ConvolutionJob;
using selfcorrect::Image;
using selfcorrect::layer_floats;
using selfcorrect::row_pixels;
using selfcorrect::Task;

constexpr int step_rows = 8;          // of the wavefront
constexpr int ring = step_rows + 2;   // rows of a layer's input that it needs at a time
constexpr int group = 16;             // pixels that are turned over at once

inline int least(int a, int b) { return a < b ? a : b; }
inline int most(int a, int b) { return a > b ? a : b; }

inline char* aligned(char* p) { return p + (64 - reinterpret_cast<std::uintptr_t>(p) % 64) % 64; }

// Rows of one layer, zero above and below; a row's address is that of its first pixel.
struct Rows {
    char* base;
    char* zeros;
    std::int64_t row_bytes;
    int height, count, pixel_bytes;  // count < height: a ring

    char* operator()(int y) const {
        if (y < 0 || y >= height) return zeros;
        return base + y % count * row_bytes + border * pixel_bytes;
    }
};

std::int64_t zeros_size(int width) { return row_pixels(width) * gradient_bytes; }

char* make_zeros(char* memory, int width) {
    std::memset(memory, 0, zeros_size(width));
    return memory + border * gradient_bytes;
}

std::int64_t line_size(int width) { return row_pixels(width) * filters * sizeof(float); }

void logarithm(float* values) {
    for (int i = 0; i < group; i += lanes)
        store(values + i, log2_above_one(maximum(load(values + i) + 1.0f, splat(1.0f))) * 0.69314718f);
}

// Of known size, mostly: copies of any number of bytes take as long as all else.
inline void copy(float* to, const float* from, int n) {
    if (n == group)
        std::memcpy(to, from, sizeof(float) * group);
    else
        for (int i = 0; i < n; ++i) to[i] = from[i];
}

// Row y of planes to a line of pixels.
void read_row(const float* planes, std::int64_t plane_stride, int channels, bool log_radiance, int width, float* line) {
    for (int x = 0; x < width; x += group) {
        float values[filters * group] = {};
        const int n = least(group, width - x);
        for (int c = 0; c < channels; ++c) {
            copy(values + c * group, planes + c * plane_stride + x, n);
            if (log_radiance && (c < 3 || c >= channels - 3)) logarithm(values + c * group);
        }
        transpose(values, line + x * filters);
    }
}

void write_row(const float* line, int channels, int width, float* planes, std::int64_t plane_stride) {
    for (int x = 0; x < width; x += group) {
        float values[filters * group];
        transpose(line + x * filters, values);
        const int n = least(group, width - x);
        for (int c = 0; c < channels; ++c)
            copy(planes + c * plane_stride + x, values + c * group, n);
    }
}

// The input of layer `stage`, whole for the backward pass or as a ring.
Rows stage_rows(const ConvolutionJob& job, int patch, int stage, int width, char* memory, char* zeros) {
    const std::int64_t row_bytes = row_pixels(width) * activation_bytes;
    if (job.kept) {
        char* base = job.kept + (std::int64_t(patch) * job.layers + stage) * job.height * row_bytes;
        return {base, zeros, row_bytes, job.height, job.height, activation_bytes};
    }
    return {memory + stage * ring * row_bytes, zeros, row_bytes, job.height, ring, activation_bytes};
}

std::int64_t forward_scratch(const ConvolutionJob& job, int region_width) {
    const int width = least(job.width, region_width + 2 * job.layers);
    const std::int64_t rings = job.kept ? 0 : job.layers * ring * row_pixels(width) * activation_bytes;
    return zeros_size(width) + line_size(width) + rings + 64;
}

// One task: where its rows are and how one more of them comes about.
class Forward {
public:
    Forward(const ConvolutionJob& job, const Task& task, char* scratch) : job(job), task(task) {
        first = most(0, task.left - job.layers);
        width = least(job.width, task.right + job.layers) - first;
        memory = aligned(scratch);
        zeros = make_zeros(memory, width);
        memory += zeros_size(width);
        line = reinterpret_cast<float*>(memory);
        memory += line_size(width);
    }

    void run() {
        const int rows = job.kept ? job.height + 2 * job.layers : step_rows;
        for (int step = task.top - job.layers; step < task.bottom + job.layers; step += rows)
            for (int stage = 0; stage <= job.layers; ++stage) {
                const int reach = job.layers - stage;  // rows around the task that later layers see
                const int begin = most(step - stage, most(0, task.top - reach));
                const int end = least(step - stage + rows, least(job.height, task.bottom + reach));
                for (int y = begin; y < end; ++y) make_row(stage, y);
            }
    }

private:
    void make_row(int stage, int y) {
        if (stage == 0) {
            const Image& image = job.images[task.patch];
            read_row(image.pixels + y * image.row_stride + first, image.plane_stride, job.inputs, job.log_radiance,
                     width, line);
        } else {
            const Rows in = stage_rows(job, task.patch, stage - 1, width, memory, zeros);
            const char* rows[3] = {in(y - 1), in(y), in(y + 1)};
            convolve<true>(rows, stage == 1 ? job.inputs : filters, job.packed + (stage - 1) * layer_floats, width,
                           line);
        }
        if (stage < job.layers) {
            keep_activation(line, width, stage > 0, stage_rows(job, task.patch, stage, width, memory, zeros)(y));
        } else {
            const std::int64_t row = job.right - job.left, plane = row * (job.bottom - job.top);
            write_row(line + (task.left - first) * filters, job.heads, task.right - task.left,
                      job.output + task.patch * job.heads * plane + (y - job.top) * row + task.left - job.left, plane);
        }
    }

    const ConvolutionJob& job;
    const Task& task;
    int first, width;  // columns that the task's depend on
    char *memory, *zeros;
    float* line;
};

void forward(const ConvolutionJob& job, const Task& task, char* scratch) {
    const Setup setup;
    Forward(job, task, scratch).run();
}

std::int64_t backward_scratch(const ConvolutionJob& job) {
    const std::int64_t gradients = 2 * job.height * row_pixels(job.width) * gradient_bytes;
    return zeros_size(job.width) + line_size(job.width) + gradients + weight_scratch(job.height, job.width) + 64;
}

// Layer by layer; weights' and biases' gradients are added to the patch's own.
void backward(const ConvolutionJob& job, int patch, char* scratch) {
    char* memory = aligned(scratch);
    char* zeros = make_zeros(memory, job.width);
    memory += zeros_size(job.width);
    float* line = reinterpret_cast<float*>(memory);
    memory += line_size(job.width);
    const std::int64_t row_bytes = row_pixels(job.width) * gradient_bytes;
    Rows upstream{memory, zeros, row_bytes, job.height, job.height, gradient_bytes};
    Rows downstream = upstream;
    downstream.base += job.height * row_bytes;
    memory += 2 * job.height * row_bytes;

    float* gradients = job.gradients + std::int64_t(patch) * job.layers * layer_floats;
    const auto bias = [&](int layer) { return gradients + layer * layer_floats + selfcorrect::layer_weights; };
    for (int y = 0; y < job.height; ++y) {
        const float* planes = job.upstream + patch * job.upstream_strides[0] + y * job.upstream_strides[2];
        read_row(planes, job.upstream_strides[1], job.heads, false, job.width, line);
        keep_gradient(line, job.width, nullptr, upstream(y), bias(job.layers - 1));
    }
    for (int layer = job.layers - 1; layer >= 0; --layer) {
        const Rows activation = stage_rows(job, patch, layer, job.width, nullptr, zeros);
        weight_gradient(activation, upstream, layer == 0 ? job.inputs : filters, job.height, job.width,
                        gradients + layer * layer_floats, memory);
        if (layer == 0) return;
        const Setup setup;
        for (int y = 0; y < job.height; ++y) {
            const char* rows[3] = {upstream(y - 1), upstream(y), upstream(y + 1)};
            convolve<false>(rows, layer == job.layers - 1 ? job.heads : filters,
                     job.packed + layer * layer_floats, job.width, line);
            keep_gradient(line, job.width, activation(y), downstream(y), bias(layer - 1));
        }
        char* const base = upstream.base;
        upstream.base = downstream.base;
        downstream.base = base;
    }
}

}  // namespace

namespace selfcorrect {

Convolution SELFCORRECT_CONVOLUTION() {
    return {activation_bytes, pack, forward_scratch, backward_scratch, forward, backward, peak};
}

}  // namespace selfcorrect
