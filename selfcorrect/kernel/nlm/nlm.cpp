// Non-local means with variance cancellation (Rousselle et al. 2012, Eqs. 3-5): one tap of the window for a strip of
// rows at a time, so that a patch's distance is a box sum over neighbours that share the tap. Compiled once per
// instruction set, like cross_bilateral.cpp; reference.py is the readable form.

#include "nlm.h"

#include "simd.h"

namespace {

using selfcorrect::NonLocal;

constexpr float epsilon = 1e-10f;  // Eq. 3

// Distance of every pixel of a row to the one `shift` away, summed over the channels.
void row_distances(const NonLocal& job, const float* guide, const float* variance, std::int64_t shift, int count,
                   float* out) {
    for (int x = 0; x < count; x += lanes) {
        Float sum = {};
        for (int c = 0; c < job.channels; ++c) {
            const float* u = guide + c * job.plane_stride + x;
            const float* v = variance + c * job.plane_stride + x;
            const Float difference = load(u) - load(u + shift), own = load(v), other = load(v + shift);
            const Float cancelled = difference * difference - (own + minimum(own, other));
            sum += cancelled / (epsilon + job.k_squared * (own + other));
        }
        store(out + x, sum);
    }
}

}  // namespace

namespace selfcorrect {

void SELFCORRECT_VARIANT(weigh)(const NonLocal& job, std::int64_t tap, float* scratch) {
    const int side = 2 * job.radius + 1, f = job.patch_radius, patch = 2 * f + 1;
    const std::int64_t shift = (tap / side - job.radius) * job.row_stride + tap % side - job.radius;
    const int wide = int(job.weight_columns);
    const std::int64_t stride = wide + 2 * f + 32;
    float* line = scratch;  // distances of one row; then a row of sums for each row that is touched
    float* sums = scratch + stride;
    for (int y = -f; y < job.rows + f; ++y) {
        const std::int64_t offset = (job.first_row + y + job.margin) * job.row_stride + job.margin - f;
        row_distances(job, job.guide + offset, job.variance + offset, shift, wide + 2 * f, line);
        for (int x = 0; x < wide; x += lanes) {
            Float sum = {};
            for (int i = 0; i < patch; ++i) sum += load(line + x + i);
            store(sums + (y + f) * stride + x, sum);
        }
    }
    const float share = -1.44269504f / float(job.channels * patch * patch);
    for (int y = 0; y < job.rows; ++y) {
        float* out = job.weights + (tap * job.rows + y) * job.weight_columns;
        for (int x = 0; x < wide; x += lanes) {
            Float sum = {};
            for (int i = 0; i < patch; ++i) sum += load(sums + (y + i) * stride + x);
            store(out + x, exp2_nonpositive(maximum(sum, Float{}) * share));
        }
    }
}

void SELFCORRECT_VARIANT(average)(const NonLocal& job, std::int64_t row, float*) {
    const int side = 2 * job.radius + 1;
    for (int x = 0; x < job.width; x += lanes) {
        Float weight_sum = {}, sum[4] = {};
        const float* w = job.weights + row * job.weight_columns + x;
        for (int tap = 0; tap < side * side; ++tap, w += job.rows * job.weight_columns) {
            const Float weight = load(w);
            const float* p = job.values + (job.first_row + row + job.margin + tap / side - job.radius) * job.row_stride +
                             x + job.margin + tap % side - job.radius;
            for (int c = 0; c < job.channels; ++c) sum[c] += weight * load(p + c * job.plane_stride);
            weight_sum += weight;
        }
        const int n = job.width - x < lanes ? job.width - x : lanes;
        for (int c = 0; c < job.channels; ++c) {
            const Float mean = sum[c] / weight_sum;  // the centre weighs 1
            float* out = job.output + (std::int64_t(c) * job.rows + row) * job.width + x;
            for (int i = 0; i < n; ++i) out[i] = mean[i];
        }
    }
}

}  // namespace selfcorrect
