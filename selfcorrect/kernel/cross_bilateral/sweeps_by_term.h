// The two sweeps over the window where a processor has 16 vector registers: a row of taps goes through one small loop
// after the other, each with all that it uses over and over in registers. One loop with everything in it loads most of
// that again at every tap, and is a third slower. The sums are those of sweeps_at_once.h, bit for bit.
#pragma once

#include "taps.h"

namespace {

// A row of taps; what is kept of each begins with its exponent, then its weight.
template <unsigned Present>
struct TapRow {
    const Taps<Present>& taps;
    const float* p;
    int count, every;
    float* kept;

    float* tap(int i) const { return kept + i * Taps<Present>::kept; }
    float* logarithm(int i, int m) const { return tap(i) + (1 + Taps<Present>::at.logarithm[m]) * lanes; }
    const float* pixel(int i) const { return p + i * every; }
};

// The logarithmic distances in one term, and what they add to the exponents.
template <int M, unsigned Present>
inline void measure_logarithm(const TapRow<Present>& row, Float factor) {
    const auto c = row.taps.template centre_of<M>();
    for (int i = 0; i < row.count; ++i) {
        const auto d = c - row.taps.template guide<M>(row.pixel(i));
        const Float distance = log2_above_one(dot(d, d, splat(1.0f)));
        store(row.logarithm(i, M), distance);
        store(row.tap(i), M == 0 ? distance * factor : load(row.tap(i)) + distance * factor);
    }
}

// What the other terms add to them.
template <unsigned Present>
inline void measure_squares(const TapRow<Present>& row, const Float* factors) {
    const Taps<Present> taps = row.taps;
    Float factor[term_count];
    for_each_term<Present>([&](auto m) { factor[m.value] = factors[m.value]; });
    for (int i = 0; i < row.count; ++i) {
        Float exponent = load(row.tap(i));
        for_each_term<Present>([&](auto m) {
            if constexpr (!terms[m.value].logarithmic) {
                const auto d = taps.template centre_of<m.value>() - taps.template guide<m.value>(row.pixel(i));
                exponent += dot(d, d, Float{}) * factor[m.value];
            }
        });
        store(row.tap(i), exponent);
    }
}

// Sums of the weights, if `Weights`, and of the weighted differences in the terms of `Some`.
template <bool Weights, unsigned Some, unsigned Present>
inline void add_up(const TapRow<Present>& row, Float& w_sum, Three* sums) {
    const Taps<Present> taps = row.taps;
    Three sum[term_count];
    for_each_term<Present & Some>([&](auto m) { sum[m.value] = sums[m.value]; });
    Float total = w_sum;
    for (int i = 0; i < row.count; ++i) {
        const Float w = load(row.tap(i));
        if constexpr (Weights) total += w;
        for_each_term<Present & Some>([&](auto m) {
            if constexpr (Taps<Present>::raised(m.value))
                accumulate(sum[m.value], w,
                           taps.template centre_of<m.value>() - taps.template guide<m.value>(row.pixel(i)));
        });
    }
    for_each_term<Present & Some>([&](auto m) { sums[m.value] = sum[m.value]; });
    w_sum = total;
}

// Sums over the window of the weights and of the weighted differences to the centre. Where `Keep`, each tap's weight and
// logarithmic distances are left at `kept`; `factor` is negative and for exp2.
template <bool Keep, unsigned Present>
inline void gather_taps(const Taps<Present>& taps, const Float* factor, Float centre_weight, float* kept, Float& w_sum,
                        Three* sum) {
    constexpr unsigned radiance = 1u << noisy | 1u << denoised;
    const int every = taps.job.every;
    taps.for_each_row([&](int dy, int first, const float* p, int count) {
        const TapRow<Present> row{taps, p, count, every, kept};
        for_each_term<Present>([&](auto m) {
            if constexpr (terms[m.value].logarithmic) measure_logarithm<m.value>(row, factor[m.value]);
        });
        measure_squares(row, factor);
        for (int i = 0; i < count; ++i) store(row.tap(i), exp2_nonpositive(load(row.tap(i))));
        if (dy == 0) store(row.tap(-first / every), centre_weight);
        add_up<true, radiance>(row, w_sum, sum);
        add_up<false, ~radiance>(row, w_sum, sum);
        if (Keep) kept += count * taps.kept;
    });
}

// s_i = G.(y_i - y_c) + (G beta).(z_c - z_i) + ... - s_centre of a row of taps, as far as y and z make it.
template <unsigned Present>
inline void scatter_radiance(const TapRow<Present>& row, Three gradient, Three by, Float s_centre, Float* s) {
    const Three y = row.taps.template centre_of<noisy>(), z = row.taps.template centre_of<denoised>();
    for (int i = 0; i < row.count; ++i) {
        const Float of_noisy = dot(gradient, row.taps.template guide<noisy>(row.pixel(i)) - y, -s_centre);
        s[i] = dot(by, z - row.taps.template guide<denoised>(row.pixel(i)), of_noisy);
    }
}

// The rest of it; then s becomes w s, which is summed up with the squared distances.
template <unsigned Present>
inline void scatter_features(const TapRow<Present>& row, const Three* by, Float* s, Float* sums) {
    const Taps<Present> taps = row.taps;
    Three b[term_count];
    Float sum[term_count];
    for_each_term<Present>([&](auto m) {
        if constexpr (terms[m.value].scale) b[m.value] = by[m.value];
        sum[m.value] = sums[m.value];
    });
    for (int i = 0; i < row.count; ++i) {
        Float t = s[i], squared[term_count];
        for_each_term<Present>([&](auto m) {
            if constexpr (!terms[m.value].logarithmic) {
                const auto d = taps.template centre_of<m.value>() - taps.template guide<m.value>(row.pixel(i));
                if constexpr (terms[m.value].scale) t = dot(b[m.value], d, t);
                squared[m.value] = dot(d, d, Float{});
            }
        });
        t *= load(row.tap(i));
        for_each_term<Present>([&](auto m) {
            if constexpr (!terms[m.value].logarithmic) sum[m.value] += t * squared[m.value];
        });
        s[i] = t;
    }
    for_each_term<Present>([&](auto m) { sums[m.value] = sum[m.value]; });
}

// Sums over the window of w_i s_i times each distance.
template <unsigned Present>
inline void scatter_taps(const Taps<Present>& taps, const Three& gradient, const Three* by, Float s_centre,
                         float* kept, Float* sum) {
    const int every = taps.job.every;
    taps.for_each_row([&](int, int, const float* p, int count) {
        const TapRow<Present> row{taps, p, count, every, kept};
        Float s[largest_window];
        scatter_radiance(row, gradient, by[denoised], s_centre, s);
        scatter_features(row, by, s, sum);
        for (int i = 0; i < count; ++i)
            for_each_term<Present>([&](auto m) {
                if constexpr (terms[m.value].logarithmic) sum[m.value] += s[i] * load(row.logarithm(i, m.value));
            });
        kept += count * taps.kept;
    });
}

}  // namespace
