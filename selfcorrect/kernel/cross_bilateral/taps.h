// A block of pixels in their window: what each tap has, and how vectors of three channels are added up.
#pragma once

#include "job.h"
#include "simd.h"

namespace {

using selfcorrect::Job;

constexpr float log2_e = 1.44269504f;
constexpr int largest_window = 31;

// A pixel's values of a guide.
template <int Channels>
struct Vector {
    Float v[Channels];
};

using Three = Vector<3>;

template <int Channels>
inline Vector<Channels> load_planes(const float* p, std::int64_t plane_stride) {
    Vector<Channels> x;
    for (int k = 0; k < Channels; ++k) x.v[k] = load(p + k * plane_stride);
    return x;
}

template <int Channels>
inline Vector<Channels> operator-(const Vector<Channels>& a, const Vector<Channels>& b) {
    Vector<Channels> d;
    for (int k = 0; k < Channels; ++k) d.v[k] = a.v[k] - b.v[k];
    return d;
}

template <int Channels>
inline Float dot(const Vector<Channels>& a, const Vector<Channels>& b, Float sum) {
    for (int k = 0; k < Channels; ++k) sum += a.v[k] * b.v[k];
    return sum;
}

// sum += w d
inline void accumulate(Three& sum, Float w, const Three& d) {
    for (int k = 0; k < 3; ++k) sum.v[k] += w * d.v[k];
}

// `Present` is the set of terms.
template <unsigned Present>
struct Taps {
    static constexpr Layout at = layout(Present);
    static constexpr int kept = at.kept * lanes;  // floats of each tap

    const Job& job;
    std::int64_t stride;  // of planes
    std::int64_t offset;  // of the block's first pixel
    Three centre[term_count];

    explicit Taps(const Job& job, std::int64_t offset) : job(job), stride(job.plane_stride), offset(offset) {
        for_each_term<Present>([&](auto m) {
            const auto c = guide<m.value>(job.planes + offset);
            for (int k = 0; k < terms[m.value].channels; ++k) centre[m.value].v[k] = c.v[k];
        });
    }

    // Whether the output has the term's differences, not the weights alone.
    static constexpr bool raised(int m) { return m == noisy || terms[m].scale; }

    template <int M>
    Vector<terms[M].channels> guide(const float* pixel) const {
        return load_planes<terms[M].channels>(pixel + at.plane[M] * stride, stride);
    }

    template <int M>
    Vector<terms[M].channels> centre_of() const {
        Vector<terms[M].channels> c;
        for (int k = 0; k < terms[M].channels; ++k) c.v[k] = centre[M].v[k];
        return c;
    }

    // Calls f(dy, dx of the first tap, its pixel, number of taps) for every row of the window. Taps with dx = slope dy
    // (mod every) are taken: a lattice that has the centre and is spread over all rows.
    template <class Function>
    void for_each_row(const Function& f) const {
        const int radius = job.window / 2, slope = job.every < 4 ? 1 : 2;
        for (int dy = -radius; dy <= radius; ++dy) {
            const int first = -radius + (slope * dy + radius + job.every * job.window) % job.every;
            f(dy, first, job.planes + offset + dy * job.row_stride + first, (radius - first) / job.every + 1);
        }
    }
};

}  // namespace
