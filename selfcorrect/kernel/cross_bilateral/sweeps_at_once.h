// The two sweeps over the window where a processor has 32 vector registers: one loop over the taps that does everything,
// its sums, the centre and the factors in registers all the while.
#pragma once

#include "taps.h"

namespace {

// Sums over the window of the weights and of the weighted differences to the centre. Where `Keep`, each tap's weight and
// logarithmic distances are left at `kept`; `factor` is negative and for exp2.
template <bool Keep, unsigned Present>
inline void gather_taps(const Taps<Present>& taps, const Float* factor, Float centre_weight, float* kept, Float& w_sum,
                        Three* sum) {
    const int every = taps.job.every;
    taps.for_each_row([&](int dy, int dx, const float* p, int count) {
        for (int i = 0; i < count; ++i, dx += every, p += every) {
            Three d[term_count];
            Float distance[term_count], exponent;
            for_each_term<Present>([&](auto m) {
                const auto difference = taps.template centre_of<m.value>() - taps.template guide<m.value>(p);
                if constexpr (Taps<Present>::raised(m.value)) d[m.value] = difference;
                if constexpr (terms[m.value].logarithmic)
                    distance[m.value] = log2_above_one(dot(difference, difference, splat(1.0f)));
                else
                    distance[m.value] = dot(difference, difference, Float{});
                if constexpr (m.value == 0)
                    exponent = distance[0] * factor[0];
                else
                    exponent += distance[m.value] * factor[m.value];
            });
            Float w = exp2_nonpositive(exponent);
            if (dx == 0 && dy == 0) w = centre_weight;
            w_sum += w;
            for_each_term<Present>([&](auto m) {
                if constexpr (Taps<Present>::raised(m.value)) accumulate(sum[m.value], w, d[m.value]);
            });
            if constexpr (Keep) {
                store(kept, w);
                kept += lanes;
                for_each_term<Present>([&](auto m) {
                    if constexpr (terms[m.value].logarithmic) {
                        store(kept, distance[m.value]);
                        kept += lanes;
                    }
                });
            }
        }
    });
}

// Sums over the window of w_i s_i times each distance, with s_i = G.(y_i - y_c) + (G beta).(z_c - z_i) + ... - s_centre.
template <unsigned Present>
inline void scatter_taps(const Taps<Present>& taps, const Three& gradient, const Three* by, Float s_centre,
                         const float* kept, Float* sum) {
    const int every = taps.job.every;
    taps.for_each_row([&](int, int, const float* p, int count) {
        for (int i = 0; i < count; ++i, p += every, kept += taps.kept) {
            Float s = dot(gradient, taps.template guide<noisy>(p) - taps.template centre_of<noisy>(), -s_centre);
            Float squared[term_count];
            for_each_term<Present>([&](auto m) {
                if constexpr (m.value != noisy) {
                    const auto d = taps.template centre_of<m.value>() - taps.template guide<m.value>(p);
                    if constexpr (terms[m.value].scale) s = dot(by[m.value], d, s);
                    if constexpr (!terms[m.value].logarithmic) squared[m.value] = dot(d, d, Float{});
                }
            });
            const Float t = load(kept) * s;
            const float* keep = kept + lanes;
            for_each_term<Present>([&](auto m) {
                if constexpr (terms[m.value].logarithmic) {
                    sum[m.value] += t * load(keep);
                    keep += lanes;
                } else {
                    sum[m.value] += t * squared[m.value];
                }
            });
        }
    });
}

}  // namespace
