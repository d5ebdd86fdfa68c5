// The kernel alone, for neon.py: cases from stdin, what it makes of them to stdout, both as plain numbers.

#include <cstdio>
#include <cstdlib>
#include <vector>

#include "job.h"

namespace {

template <class T>
std::vector<T> read(std::int64_t count) {
    std::vector<T> values(count);
    if (std::fread(values.data(), sizeof(T), count, stdin) != std::size_t(count)) std::exit(3);
    return values;
}

void write(const std::vector<float>& values) { std::fwrite(values.data(), sizeof(float), values.size(), stdout); }

}  // namespace

int main() {
    std::int64_t cases = read<std::int64_t>(1)[0];
    while (cases--) {
        // present, eq3, window, every, patches, height, width, heads; channels, rows and columns of the padded planes
        const auto n = read<std::int64_t>(11);
        selfcorrect::Job job{};
        job.present = unsigned(n[0]);
        job.eq3 = n[1] != 0;
        job.window = int(n[2]);
        job.every = int(n[3]);
        job.patches = int(n[4]);
        job.height = int(n[5]);
        job.width = int(n[6]);
        job.plane_stride = n[9] * n[10];
        job.row_stride = n[10];
        const std::int64_t pixels = n[5] * n[6];
        for (auto* strides : {job.head_strides, job.gradient_strides}) {
            strides[0] = n[7] * pixels;
            strides[1] = pixels;
            strides[2] = n[6];
            strides[3] = 1;
        }
        const auto corners = read<std::int64_t>(2 * n[4]);
        const auto planes = read<float>(n[8] * job.plane_stride), heads = read<float>(n[4] * n[7] * pixels);
        const auto target = read<float>(3 * job.plane_stride), weight = read<float>(job.plane_stride);
        std::vector<float> output(n[4] * 3 * pixels), gradient(heads.size());
        std::vector<double> row_loss(n[4] * n[5]);
        std::vector<float> scratch(selfcorrect::scratch_size(job.window));
        job.corners = corners.data();
        job.planes = planes.data();
        job.heads = heads.data();
        job.heads_gradient = gradient.data();
        job.output = output.data();
        job.target = target.data();
        job.weight = weight.data();
        job.row_loss = row_loss.data();
        for (const auto mode : {selfcorrect::Mode::forward, selfcorrect::Mode::loss})
            for (std::int64_t row = 0; row < n[4] * n[5]; ++row)
                selfcorrect::row_baseline(job, mode, row, scratch.data());
        write(output);
        write(gradient);
    }
}
