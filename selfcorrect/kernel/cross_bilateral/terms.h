// Which buffers Eqs. 10 and 11 have terms for, and where each lies among the planes and the heads. The rows are those of
// TERMS in buffers.py, in its order: CMakeLists.txt writes them to term_rows.h, so that there is no second table.
#pragma once

namespace {

struct Term {
    const char* name;
    int channels;
    int place;         // among the planes, ascending
    bool always;       // every frame has it
    bool scale;        // Eq. 10 has a beta for it, three channels
    bool logarithmic;  // Eq. 11 measures it by ln(1 + d^2), not d^2
};

constexpr Term terms[] = {
#include "term_rows.h"
};
constexpr int term_count = sizeof terms / sizeof *terms;
constexpr int noisy = 0, denoised = 1;  // y and z, whose differences make the output

// Bit m of a set of terms is row m.
constexpr bool has(unsigned present, int m) { return present >> m & 1; }

constexpr unsigned always_present() {
    unsigned set = 0;
    for (int m = 0; m < term_count; ++m) set |= unsigned(terms[m].always) << m;
    return set;
}

// Every frame has the first rows and no others: what may be missing is a range of bits.
static_assert(always_present() == (1u << noisy | 1u << denoised), "colour and denoised colour come first in TERMS");
static_assert(!terms[noisy].scale && terms[denoised].scale, "Eq. 10 scales z, not y");
constexpr int optional_terms = term_count - 2;

// Where a frame's terms lie; the entries of absent ones mean nothing.
struct Layout {
    int plane[term_count];  // first one
    int beta[term_count];   // first head; those of Eq. 10 only
    int gamma[term_count];  // among the bandwidths
    int logarithm[term_count];  // among the logarithmic distances
    int betas, gammas;
    int kept;  // floats kept of each tap: its weight and the logarithmic distances
};

constexpr Layout layout(unsigned present) {
    Layout at{};
    at.kept = 1;
    for (int m = 0; m < term_count; ++m) {
        if (!has(present, m)) continue;
        for (int k = 0; k < term_count; ++k)
            if (has(present, k) && terms[k].place < terms[m].place) at.plane[m] += terms[k].channels;
        at.beta[m] = at.betas;
        at.betas += terms[m].scale ? 3 : 0;
        at.gamma[m] = at.gammas++;
        at.logarithm[m] = at.kept - 1;
        at.kept += terms[m].logarithmic;
    }
    return at;
}

constexpr int most_kept = layout((1u << term_count) - 1).kept;

template <int M>
struct Row {
    static constexpr int value = M;
};

// Calls f(Row<m>()) for each term in `Present`, in order; everything that depends on m is known to the compiler.
template <unsigned Present, int M = 0, class Function>
inline void for_each_term(const Function& f) {
    if constexpr (M < term_count) {
        if constexpr (has(Present, M)) f(Row<M>());
        for_each_term<Present, M + 1>(f);
    }
}

}  // namespace
