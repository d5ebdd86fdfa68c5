// What Python calls for the convolutions: lays weights out, cuts the work into tasks, releases the GIL. Patches (and, where
// nothing is kept, pieces of them) are independent, and their weights' gradients are added in the patches' order, so
// the result does not depend on the number of threads.

#include "bindings.h"

#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "convolution.h"
#include "pool.h"
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

std::vector<std::string> convolution_instruction_sets() {
    auto names = selfcorrect::instruction_sets();
#if defined(SELFCORRECT_DOTS)
    if (names.back() == "avx512" && __builtin_cpu_supports("avx512bf16")) names.push_back("avx512bf16");
#endif
#if defined(SELFCORRECT_AMX)
    static const bool amx = has_amx();
    if (amx) names.push_back("amx");
#endif
    return names;
}

Convolution variant(const std::string& name) {
    const auto names = convolution_instruction_sets();
    if (std::find(names.begin(), names.end(), name) == names.end())
        throw std::invalid_argument("expected an instruction set this processor has, but got " + name);
#if defined(SELFCORRECT_AMX)
    if (name == "amx") return convolution_amx();
#endif
#if defined(SELFCORRECT_DOTS)
    if (name == "avx512bf16") return convolution_avx512bf16();
#endif
#if defined(SELFCORRECT_X86)
    if (name == "avx512") return convolution_avx512();
    if (name == "avx2") return convolution_avx2();
#endif
    return convolution_baseline();
}

// Where the weights and biases of a layer of `ins` inputs and `outs` outputs are in torch's (out, in, 3, 3) and in ours.
template <class Pair>
void each_weight(int ins, int outs, bool turned, const Pair& pair) {
    int theirs = 0;
    for (int o = 0; o < outs; ++o)
        for (int i = 0; i < ins; ++i)
            for (int tap = 0; tap < 9; ++tap, ++theirs)
                pair(theirs, turned ? ((8 - tap) * filters + o) * filters + i : (tap * filters + i) * filters + o);
    if (turned) return;
    for (int o = 0; o < outs; ++o, ++theirs) pair(theirs, layer_weights + o);
}

std::int64_t parameters(int ins, int outs) { return (9 * ins + 1) * outs; }

// A job with all layers' weights packed, for the forward pass or turned round for the backward pass. `flat` holds weight and
// bias of each layer in turn; `widths` the channels before, between and after the layers.
struct Network {
    std::vector<float> packed;
    ConvolutionJob job{};

    Network(const Convolution& way, const float* flat, const std::vector<int>& widths, bool turned) {
        job.layers = int(widths.size()) - 1;
        job.inputs = widths.front();
        job.heads = widths.back();
        packed.resize(std::size_t(job.layers) * layer_floats);
        job.packed = packed.data();
        for (int layer = 0; layer < job.layers; ++layer) {
            float laid[layer_floats] = {};
            each_weight(widths[layer], widths[layer + 1], turned, [&](int theirs, int ours) { laid[ours] = flat[theirs]; });
            way.pack(laid, turned, packed.data() + layer * layer_floats);
            flat += parameters(widths[layer], widths[layer + 1]);
        }
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

void forward(const std::vector<Array>& images, Array flat, const std::vector<int>& widths, bool log_radiance,
             const std::vector<int>& region, const std::string& instruction_set, int threads, Bytes kept, Array output) {
    const Convolution way = variant(instruction_set);
    Network network(way, flat.data(), widths, false);
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

// Adds up the patches' gradients, in their order, to one laid out as the parameters are.
void collect(const ConvolutionJob& job, int patches, const std::vector<int>& widths, float* flat) {
    for (int layer = 0; layer < job.layers; ++layer) {
        float sum[layer_floats] = {};
        for (int patch = 0; patch < patches; ++patch) {
            const float* from = job.gradients + (std::int64_t(patch) * job.layers + layer) * layer_floats;
            for (int i = 0; i < layer_floats; ++i) sum[i] += from[i];
        }
        each_weight(widths[layer], widths[layer + 1], false, [&](int theirs, int ours) { flat[theirs] = sum[ours]; });
        flat += parameters(widths[layer], widths[layer + 1]);
    }
}

void backward(Array flat, const std::vector<int>& widths, const std::string& instruction_set, int threads, Bytes kept,
              Array upstream, Array gradient) {
    const Convolution way = variant(instruction_set);
    Network network(way, flat.data(), widths, true);
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
    collect(job, patches, widths, gradient.data());
}

std::int64_t kept_bytes(const std::string& instruction_set, int patches, int layers, int height, int width) {
    return variant(instruction_set).pixel_bytes * row_pixels(width) * height * layers * patches;
}

}  // namespace

void bind_convolution(nb::module_& m) {
    m.def("convolution_instruction_sets", &convolution_instruction_sets, "Names this processor can run, slowest first.");
    m.def("convolution_kept_bytes", &kept_bytes, "Memory that the backward pass needs of the forward pass.");
    m.def("convolution_peak",
          [](const std::string& instruction_set, std::int64_t rounds) { return variant(instruction_set).peak(rounds); },
          "Runs multiply-adds only; returns how many.");
    m.def("convolution_forward", &forward);
    m.def("convolution_backward", &backward);
}
