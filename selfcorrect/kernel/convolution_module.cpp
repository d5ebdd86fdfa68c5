// Python's door to the convolutions: lays weights out, cuts the work into tasks, releases the GIL. Patches (and, where
// nothing is kept, pieces of them) are independent, and their weights' gradients are added in the patches' order, so
// the result does not depend on the number of threads.

#include "convolution_module.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "convolution.h"
#include "processor.h"
#if defined(SELFCORRECT_AMX)
#include <cpuid.h>
#include <sys/syscall.h>
#include <unistd.h>
#endif

namespace nb = nanobind;
using namespace selfcorrect;
using Array = nb::ndarray<float, nb::device::cpu>;
using Bytes = nb::ndarray<std::uint8_t, nb::device::cpu, nb::c_contig>;

namespace {

constexpr int band_rows = 128, band_columns = 480;  // of a task: all layers' three rows stay in a core's L2 cache

#if defined(SELFCORRECT_AMX)
bool has_amx() {
    unsigned a, b, c, d;
    if (!__get_cpuid_count(7, 1, &a, &b, &c, &d) || !(a & 1u << 5)) return false;    // AVX512_BF16
    if (!__get_cpuid_count(7, 0, &a, &b, &c, &d)) return false;
    if (!(d & 1u << 22) || !(d & 1u << 24) || !__builtin_cpu_supports("avx512bw")) return false;  // AMX-BF16, AMX-TILE
    constexpr long request_permission = 0x1023, tile_data = 18;  // Linux hands the tiles out on request only
    return syscall(SYS_arch_prctl, request_permission, tile_data) == 0;
}
#endif

std::vector<std::string> instruction_sets() {
    std::vector<std::string> names{"baseline"};
#if defined(SELFCORRECT_X86)
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) names.push_back("avx2");
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl") && __builtin_cpu_supports("avx512bw"))
        names.push_back("avx512");
#endif
#if defined(SELFCORRECT_AMX)
    static const bool amx = has_amx();
    if (amx) names.push_back("amx");
#endif
    return names;
}

Convolution variant(const std::string& name) {
    const auto names = instruction_sets();
    if (std::find(names.begin(), names.end(), name) == names.end())
        throw std::invalid_argument("expected an instruction set this processor has, but got " + name);
#if defined(SELFCORRECT_AMX)
    if (name == "amx") return convolution_amx();
#endif
#if defined(SELFCORRECT_X86)
    if (name == "avx512") return convolution_avx512();
    if (name == "avx2") return convolution_avx2();
#endif
    return convolution_baseline();
}

// (out, in, 3, 3) to [ky][kx][in][16] with the biases behind, or turned round for the way back.
void lay_out(const Array& weight, const Array* bias, bool turned, float* to) {
    std::fill(to, to + layer_floats, 0.0f);
    const float* from = weight.data();
    for (std::size_t o = 0; o < weight.shape(0); ++o)
        for (std::size_t i = 0; i < weight.shape(1); ++i)
            for (std::size_t ky = 0; ky < 3; ++ky)
                for (std::size_t kx = 0; kx < 3; ++kx) {
                    const float value = from[o * weight.stride(0) + i * weight.stride(1) + ky * weight.stride(2) +
                                             kx * weight.stride(3)];
                    const std::size_t tap = turned ? 8 - (ky * 3 + kx) : ky * 3 + kx;
                    to[(tap * filters + (turned ? o : i)) * filters + (turned ? i : o)] = value;
                }
    if (bias)
        for (std::size_t o = 0; o < bias->shape(0); ++o) to[layer_weights + o] = bias->data()[o * bias->stride(0)];
}

struct Network {
    std::vector<float> packed;
    ConvolutionJob job{};

    Network(const Convolution& way, const std::vector<Array>& weights, const std::vector<Array>* biases) {
        packed.resize(weights.size() * layer_floats);
        float laid[layer_floats];
        for (std::size_t layer = 0; layer < weights.size(); ++layer) {
            lay_out(weights[layer], biases ? &(*biases)[layer] : nullptr, !biases, laid);
            way.pack(laid, !biases, packed.data() + layer * layer_floats);
        }
        job.layers = int(weights.size());
        job.inputs = int(weights.front().shape(1));
        job.heads = int(weights.back().shape(0));
        job.packed = packed.data();
    }
};

std::vector<Task> tasks(const ConvolutionJob& job, int patches) {
    std::vector<Task> all;
    const int height = job.bottom - job.top, width = job.right - job.left;
    const int rows = job.kept ? height : band_rows, columns = job.kept ? width : band_columns;
    for (int patch = 0; patch < patches; ++patch)
        for (int y = job.top; y < job.bottom; y += rows)
            for (int x = job.left; x < job.right; x += columns)
                all.push_back({patch, y, x, std::min(y + rows, job.bottom), std::min(x + columns, job.right)});
    return all;
}

// Memory for each worker, taken by the calling thread so that it is the same from call to call.
class Scratch {
    std::int64_t each;
    std::unique_ptr<char[]> memory;

public:
    Scratch(std::int64_t each, std::int64_t workers) : each(each), memory(new char[each * workers]) {}
    char* operator[](int worker) const { return memory.get() + worker * each; }
};

void forward(const std::vector<Array>& images, const std::vector<Array>& weights, const std::vector<Array>& biases,
             bool log_radiance, std::vector<int> region, const std::string& instruction_set, int threads, Bytes kept,
             Array output) {
    const Convolution way = variant(instruction_set);
    Network network(way, weights, &biases);
    ConvolutionJob& job = network.job;
    std::vector<Image> views;
    for (const Array& image : images) views.push_back({image.data(), image.stride(0), image.stride(1)});
    job.images = views.data();
    job.height = int(images[0].shape(1));
    job.width = int(images[0].shape(2));
    job.log_radiance = log_radiance;
    job.kept = kept.size() ? reinterpret_cast<char*>(kept.data()) : nullptr;
    job.output = output.data();
    job.top = region[0], job.left = region[1], job.bottom = region[2], job.right = region[3];
    const std::vector<Task> all = tasks(job, int(images.size()));
    const auto count = std::int64_t(all.size());
    const int widest = job.kept ? job.width : std::min(band_columns, job.right - job.left);
    nb::gil_scoped_release release;
    const Scratch scratch(way.forward_scratch(job, widest), std::min<std::int64_t>(threads, count));
    spread(count, threads, [&](std::int64_t i, int worker) { way.forward(job, all[i], scratch[worker]); });
}

// Adds up the patches' gradients in their order, back in torch's layout: contiguous (out, in, 3, 3) and (out).
void collect(const ConvolutionJob& job, int patches, const std::vector<Array>& weights, std::vector<Array>& biases) {
    for (int layer = 0; layer < job.layers; ++layer) {
        float sum[layer_floats] = {};
        for (int patch = 0; patch < patches; ++patch) {
            const float* from = job.gradients + (std::int64_t(patch) * job.layers + layer) * layer_floats;
            for (int i = 0; i < layer_floats; ++i) sum[i] += from[i];
        }
        float* to = weights[layer].data();
        const int outs = int(weights[layer].shape(0)), ins = int(weights[layer].shape(1));
        for (int o = 0; o < outs; ++o)
            for (int i = 0; i < ins; ++i)
                for (int tap = 0; tap < 9; ++tap) *to++ = sum[(tap * filters + i) * filters + o];
        std::copy(sum + layer_weights, sum + layer_weights + outs, biases[layer].data());
    }
}

void backward(const std::vector<Array>& weights, const std::string& instruction_set, int threads, Bytes kept,
              Array upstream, std::vector<Array> weight_gradients, std::vector<Array> bias_gradients) {
    const Convolution way = variant(instruction_set);
    Network network(way, weights, nullptr);
    ConvolutionJob& job = network.job;
    const int patches = int(upstream.shape(0));
    job.height = int(upstream.shape(2));
    job.width = int(upstream.shape(3));
    job.kept = reinterpret_cast<char*>(kept.data());
    job.upstream = upstream.data();
    for (int i = 0; i < 3; ++i) job.upstream_strides[i] = upstream.stride(i);
    nb::gil_scoped_release release;
    std::vector<float> gradients(std::size_t(patches) * job.layers * layer_floats);
    job.gradients = gradients.data();
    const Scratch scratch(way.backward_scratch(job), std::min(threads, patches));
    spread(patches, threads, [&](std::int64_t i, int worker) { way.backward(job, int(i), scratch[worker]); });
    collect(job, patches, weight_gradients, bias_gradients);
}

std::int64_t kept_bytes(const std::string& instruction_set, int patches, int layers, int height, int width) {
    return variant(instruction_set).pixel_bytes * row_pixels(width) * height * layers * patches;
}

}  // namespace

void bind_convolution(nb::module_& m) {
    m.def("convolution_instruction_sets", &instruction_sets, "Names this processor can run, slowest first.");
    m.def("convolution_kept_bytes", &kept_bytes, "Memory that the way back needs of the way forward.");
    m.def("convolution_forward", &forward);
    m.def("convolution_backward", &backward);
}
