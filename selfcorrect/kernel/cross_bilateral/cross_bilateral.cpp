// The cross-bilateral kernel (Back et al. 2022, Eqs. 10 and 11) for one row of pixels, forward and backward in
// one visit. Compiled once per instruction set; SELFCORRECT_ROW names the entry. Everything is in an anonymous
// namespace and uses no standard template, so that no wide instruction can leak into a baseline build.
// GRADIENTS.md derives what stands here; reference.py is the readable form.

#if defined(__AVX512F__) || defined(__aarch64__)
#include "sweeps_at_once.h"
#else
#include "sweeps_by_term.h"
#endif

namespace {

using selfcorrect::Mode;

constexpr float epsilon = 1e-4f;           // Eq. 11
constexpr float centre_epsilon = 1e-4f;    // added to tau

// Lanes beyond `n` are filled with zero, so that they stay finite.
inline Float load_strided(const float* p, std::int64_t stride, int n) {
    if (stride == 1 && n == lanes) return load(p);
    float lane[lanes] = {};
    for (int i = 0; i < n; ++i) lane[i] = p[i * stride];
    return load(lane);
}

inline void store_strided(float* p, std::int64_t stride, int n, Float x) {
    if (stride == 1 && n == lanes) return store(p, x);
    float lane[lanes];
    store(lane, x);
    for (int i = 0; i < n; ++i) p[i * stride] = lane[i];
}

// Every number of a block's pixels, and what it takes to have it; `Present` is the set of terms.
template <unsigned Present>
class Block {
    static constexpr Layout at = layout(Present);

public:
    // Pixels x .. x + n - 1 (n <= lanes) of row `row` of patch `patch`.
    Block(const Job& job, int patch, int row, int x, int n, float* scratch)
        : job(job), patch(patch), row(row), x(x), n(n), scratch(scratch),
          taps(job, (job.corners[2 * patch] + row) * job.row_stride + job.corners[2 * patch + 1] + x) {}

    void activate() {
        const int betas = job.eq3 ? 0 : at.betas;
        // Eq. 3 is Eq. 10 with 1 for z and 0 for the others.
        for_each_term<Present>([&](auto m) {
            if constexpr (terms[m.value].scale)
                for (int k = 0; k < 3; ++k) beta[at.beta[m.value] + k] = splat(m.value == denoised ? 1.0f : 0.0f);
        });
        for (int k = 0; k < betas; ++k) beta[k] = tanh_(head(k));
        for (int m = 0; m < at.gammas; ++m) {
            Float slope;
            const Float gamma = softplus(head(betas + m), slope);
            inverse[m] = 1.0f / (gamma * gamma + epsilon);
            inverse_slope[m] = -2.0f * gamma * inverse[m] * inverse[m] * slope;
        }
        // Where only every n-th tap is taken, the centre counts for an n-th too.
        const float share = 1.0f / job.every;
        centre_weight = (softplus(head(betas + at.gammas), centre_slope) + centre_epsilon) * share;
        centre_slope *= share;
    }

    // Sums over the window; keeps each tap's weight and logarithmic distances for the backward sweep if Keep.
    template <bool Keep>
    void gather() {
        const int radius = job.window / 2, every = job.every;
        Float factor[term_count];  // negative and for exp2, so that each term of the exponent is one FMA
        for_each_term<Present>([&](auto m) {
            const Float i = inverse[at.gamma[m.value]];
            if constexpr (terms[m.value].logarithmic)
                factor[m.value] = -i;
            else
                factor[m.value] = i * -log2_e;
        });
        // All sums are of differences to the centre: exact where the window is constant.
        Float w_sum = {};
        Three sum[term_count] = {};
        gather_taps<Keep>(taps, factor, centre_weight, scratch, w_sum, sum);
        w_inverse = 1.0f / w_sum;
        for (int k = 0; k < 3; ++k) {
            for_each_term<Present>([&](auto m) {
                if constexpr (terms[m.value].scale) deviation[at.beta[m.value] + k] = sum[m.value].v[k] * w_inverse;
            });
            change.v[k] = -sum[noisy].v[k] * w_inverse;
            for (int b = k; b < at.betas; b += 3) change.v[k] += beta[b] * deviation[b];
            g.v[k] = taps.centre[noisy].v[k] + change.v[k];
        }
    }

    void write_output() const {
        const std::int64_t plane = std::int64_t(job.height) * job.width;
        float* out = job.output + patch * 3 * plane + std::int64_t(row) * job.width + x;
        for (int k = 0; k < 3; ++k) store_strided(out + k * plane, 1, n, g.v[k]);
    }

    Three output_gradient() const {
        const std::int64_t plane = std::int64_t(job.height) * job.width;
        const float* p = job.output_gradient + patch * 3 * plane + std::int64_t(row) * job.width + x;
        return {load_strided(p, 1, n), load_strided(p + plane, 1, n), load_strided(p + 2 * plane, 1, n)};
    }

    // Eq. 8 without its mean: adds 1/2 weight |g - target|^2 to `sum`, returns the gradient in g.
    Three loss(double& sum) const {
        const Float weight = load(job.weight + taps.offset);
        const Three target = load_planes<3>(job.target + taps.offset, taps.stride);
        Three gradient;
        Float loss = {};
        for (int k = 0; k < 3; ++k) {
            const Float residual = g.v[k] - target.v[k];
            gradient.v[k] = weight * residual;
            loss += 0.5f * gradient.v[k] * residual;
        }
        for (int i = 0; i < n; ++i) sum += loss[i];
        return gradient;
    }

    // Gradients of all raw heads from dL/dg and what gather<true>() kept.
    void scatter(const Three& gradient) {
        const Float s_centre = dot(gradient, change, Float{});
        Three by[term_count];
        for_each_term<Present>([&](auto m) {
            if constexpr (terms[m.value].scale)
                for (int k = 0; k < 3; ++k) by[m.value].v[k] = gradient.v[k] * beta[at.beta[m.value] + k];
        });
        Float sum[term_count] = {};
        scatter_taps(taps, gradient, by, s_centre, scratch, sum);
        const int betas = job.eq3 ? 0 : at.betas;
        for (int k = 0; k < betas; ++k)
            store_head(k, gradient.v[k % 3] * deviation[k] * (1.0f - beta[k] * beta[k]));
        for_each_term<Present>([&](auto m) {
            constexpr int gamma = at.gamma[m.value];
            Float total = sum[m.value];
            if constexpr (terms[m.value].logarithmic) total = total * (1.0f / log2_e);  // kept in units of log2
            store_head(betas + gamma, -total * w_inverse * inverse_slope[gamma]);
        });
        store_head(betas + at.gammas, -s_centre * w_inverse * centre_slope);  // h_c = y_c
    }

private:
    Float head(int k) const {
        const auto& s = job.head_strides;
        return load_strided(job.heads + patch * s[0] + k * s[1] + row * s[2] + x * s[3], s[3], n);
    }

    void store_head(int k, Float value) const {
        const auto& s = job.gradient_strides;
        store_strided(job.heads_gradient + patch * s[0] + k * s[1] + row * s[2] + x * s[3], s[3], n, value);
    }

    const Job& job;
    const std::int64_t patch, row, x;
    const int n;
    float* const scratch;
    const Taps<Present> taps;
    Three g, change;
    Float w_inverse, centre_weight, centre_slope;
    Float beta[at.betas], deviation[at.betas], inverse[at.gammas], inverse_slope[at.gammas];
};

template <unsigned Present>
void run_row(const Job& job, Mode mode, std::int64_t index, float* scratch) {
    const int patch = int(index / job.height), row = int(index % job.height);
    double sum = 0;
    for (int x = 0; x < job.width; x += lanes) {
        const int n = job.width - x < lanes ? job.width - x : lanes;
        Block<Present> block(job, patch, row, x, n, scratch);
        block.activate();
        if (mode == Mode::forward) {
            block.template gather<false>();
            block.write_output();
        } else {
            block.template gather<true>();
            block.scatter(mode == Mode::loss ? block.loss(sum) : block.output_gradient());
        }
    }
    if (mode == Mode::loss) job.row_loss[index] = sum;
}

// The function for the optional terms `present`: one of all their combinations.
template <unsigned Optional = 0>
selfcorrect::RowFunction variant(unsigned present) {
    if constexpr (Optional < 1u << optional_terms) {
        constexpr unsigned set = always_present() | Optional << (term_count - optional_terms);
        return present == set ? run_row<set> : variant<Optional + 1>(present);
    }
    return nullptr;
}

}  // namespace

namespace selfcorrect {

void SELFCORRECT_ROW(const Job& job, Mode mode, std::int64_t row, float* scratch) {
    variant(job.present)(job, mode, row, scratch);
}

}  // namespace selfcorrect
