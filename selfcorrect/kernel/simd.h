// One vector type as wide as the instruction set this file is compiled for, and the few functions of it
// that the kernel needs. GCC and Clang lower the arithmetic themselves, FMA contraction included.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__AVX512F__)
#include <immintrin.h>
#define SELFCORRECT_LANES 16
#elif defined(__AVX2__)
#define SELFCORRECT_LANES 8
#else  // SSE2 on baseline x86-64, NEON on ARM
#define SELFCORRECT_LANES 4
#endif

// name -> name_avx512, ...: an entry of the variant that is being compiled.
#define SELFCORRECT_JOIN(name, suffix) name##suffix
#define SELFCORRECT_JOIN_EXPANDED(name, suffix) SELFCORRECT_JOIN(name, suffix)
#define SELFCORRECT_VARIANT(name) SELFCORRECT_JOIN_EXPANDED(name, SELFCORRECT_SUFFIX)

namespace {

constexpr int lanes = SELFCORRECT_LANES;
typedef float Float __attribute__((vector_size(4 * lanes)));
typedef std::int32_t Int __attribute__((vector_size(4 * lanes)));

inline Float splat(float x) { return x - Float{}; }  // minus zero is a broadcast, plus zero an addition

inline Float load(const float* p) {
    Float x;
    std::memcpy(&x, p, sizeof x);
    return x;
}

inline void store(float* p, Float x) { std::memcpy(p, &x, sizeof x); }

inline Float maximum(Float a, Float b) {
#if defined(__AVX512F__)
    return (Float)_mm512_max_ps((__m512)a, (__m512)b);
#else
    return a > b ? a : b;
#endif
}

inline Float minimum(Float a, Float b) { return -maximum(-a, -b); }

// 2^x for x <= 0; below 2^-126 the result is 0. Relative error 8e-8 (degree-5 minimax on [0, 1]).
inline Float exp2_nonpositive(Float x) {
#if defined(__AVX512F__)
    const Float f = (Float)_mm512_reduce_ps((__m512)x, _MM_FROUND_TO_NEG_INF);  // x - floor(x)
#else
    const Float bounded = maximum(x, splat(-127.0f));
    const Int n = __builtin_convertvector(bounded, Int) - 1;  // truncation, then one below: f in (0, 1]
    const Float f = bounded - __builtin_convertvector(n, Float);
#endif
    Float p = splat(0.001877576675985079f);
    p = p * f + 0.008989340088482341f;
    p = p * f + 0.05582631805508341f;
    p = p * f + 0.24015361704373198f;
    p = p * f + 0.693153073200244f;
    p = p * f + 0.9999999250635269f;
#if defined(__AVX512F__)
    return (Float)_mm512_scalef_ps((__m512)p, (__m512)x);  // p * 2^floor(x)
#else
    const Int exponent = n + 127;
    const Float scale = (Float)((exponent > 0 ? exponent : exponent * 0) << 23);
    return p * scale;
#endif
}

// log2(x) for finite x >= 1; relative error 1.3e-6 also near 1 (log2(m)/(m-1), degree-6 minimax on [1, 2]).
inline Float log2_above_one(Float x) {
#if defined(__AVX512F__)
    const Float e = (Float)_mm512_getexp_ps((__m512)x);
    const Float m = (Float)_mm512_getmant_ps((__m512)x, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_zero) - 1.0f;
#else
    const Int bits = (Int)x;
    const Float e = __builtin_convertvector((bits >> 23) - 127, Float);
    const Float m = (Float)((bits & 0x007fffff) | 0x3f800000) - 1.0f;
#endif
    Float p = splat(0.020401185298494016f);
    p = p * m - 0.09579754892016867f;
    p = p * m + 0.2152845459908179f;
    p = p * m - 0.3390890291141802f;
    p = p * m + 0.4776683787167779f;
    p = p * m - 0.7211594743884894f;
    p = p * m + 1.4426932108813595f;
    return p * m + e;
}

// The heads' activations; x is any finite number.
inline Float sigmoid_of_negative_abs(Float x, Float& e) {
    const Float magnitude = maximum(x, -x);
    e = exp2_nonpositive(magnitude * -1.44269504f);  // exp(-|x|)
    return e / (1.0f + e);
}

inline Float tanh_(Float x) {
    Float e;
    const Float small = sigmoid_of_negative_abs(x + x, e);  // tanh |x| = 1 - 2 sigmoid(-2|x|)
    const Float t = 1.0f - 2.0f * small;
    return x < 0.0f ? -t : t;
}

inline Float softplus(Float x, Float& derivative) {
    Float e;
    const Float small = sigmoid_of_negative_abs(x, e);
    derivative = x < 0.0f ? small : 1.0f - small;
    return maximum(x, splat(0.0f)) + 0.69314718f * log2_above_one(1.0f + e);
}

}  // namespace
