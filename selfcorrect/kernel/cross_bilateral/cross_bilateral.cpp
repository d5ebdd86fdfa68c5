// The cross-bilateral kernel (Back et al. 2022, Eqs. 10 and 11) for one row of pixels, forward and backward in
// one visit. Compiled once per instruction set; SELFCORRECT_ROW names the entry. Everything is in an anonymous
// namespace and uses no standard template, so that no wide instruction can leak into a baseline build.
// GRADIENTS.md derives what stands here; reference.py is the readable form.

#include "job.h"
#include "simd.h"

namespace {

using selfcorrect::Job;
using selfcorrect::Mode;

constexpr float epsilon = 1e-4f;           // Eq. 11
constexpr float centre_epsilon = 1e-4f;    // added to tau
constexpr float log2_e = 1.44269504f;

template <bool Albedo, bool Normal, bool Visibility>
struct Guides {
    static constexpr int y = 0, albedo = 3, visibility = albedo + 3 * Albedo, normal = visibility + Visibility,
                         z = normal + 3 * Normal, count = z + 3;
    // Order of the heads: beta z, albedo, normal; gamma y, z, albedo, normal, visibility; tau.
    static constexpr int beta_albedo = 3, beta_normal = beta_albedo + 3 * Albedo, betas = beta_normal + 3 * Normal,
                         gammas = 2 + Albedo + Normal + Visibility;
};

// A pixel's 3-vector of a guide.
struct Three {
    Float v[3];
};

inline Three load3(const float* p, std::int64_t plane_stride) {
    return {load(p), load(p + plane_stride), load(p + 2 * plane_stride)};
}

inline Three operator-(const Three& a, const Three& b) {
    return {a.v[0] - b.v[0], a.v[1] - b.v[1], a.v[2] - b.v[2]};
}

inline Float dot(const Three& a, const Three& b, Float sum) {
    for (int k = 0; k < 3; ++k) sum += a.v[k] * b.v[k];
    return sum;
}

inline Float squared(const Three& d) { return dot(d, d, Float{}); }

// sum += w d
inline void accumulate(Three& sum, Float w, const Three& d) {
    for (int k = 0; k < 3; ++k) sum.v[k] += w * d.v[k];
}

inline Float log2_distance(const Three& d) { return log2_above_one(dot(d, d, splat(1.0f))); }

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

template <bool Albedo, bool Normal, bool Visibility>
class Block {
    using G = Guides<Albedo, Normal, Visibility>;

public:
    // Pixels x .. x + n - 1 (n <= lanes) of row `row` of patch `patch`.
    Block(const Job& job, int patch, int row, int x, int n, float* scratch)
        : job(job), stride(job.plane_stride), patch(patch), row(row), x(x), n(n), scratch(scratch) {
        offset = (job.corners[2 * patch] + row) * job.row_stride + job.corners[2 * patch + 1] + x;
        const float* p = job.planes + offset;
        y_c = load3(p + G::y * stride, stride);
        z_c = load3(p + G::z * stride, stride);
        if constexpr (Albedo) albedo_c = load3(p + G::albedo * stride, stride);
        if constexpr (Normal) normal_c = load3(p + G::normal * stride, stride);
        if constexpr (Visibility) visibility_c = load(p + G::visibility * stride);
    }

    void activate() {
        const int betas = job.eq3 ? 0 : G::betas;
        for (int k = 0; k < 3; ++k) beta[k] = splat(1.0f);
        for (int k = 3; k < G::betas; ++k) beta[k] = splat(0.0f);
        for (int k = 0; k < betas; ++k) beta[k] = tanh_(head(k));
        for (int m = 0; m < G::gammas; ++m) {
            Float slope;
            const Float gamma = softplus(head(betas + m), slope);
            inverse[m] = 1.0f / (gamma * gamma + epsilon);
            inverse_slope[m] = -2.0f * gamma * inverse[m] * inverse[m] * slope;
        }
        // Where only every n-th tap is taken, the centre counts for an n-th too.
        const float share = 1.0f / job.every;
        centre_weight = (softplus(head(betas + G::gammas), centre_slope) + centre_epsilon) * share;
        centre_slope *= share;
    }

    // Sums over the window; keeps each tap's weight and logarithmic distances for the way back if Keep.
    template <bool Keep>
    void gather() {
        constexpr int m_albedo = 2, m_normal = m_albedo + Albedo, m_visibility = m_normal + Normal;
        const int radius = job.window / 2, every = job.every;
        const Float i_y = -inverse[0], i_z = -inverse[1];  // negative, so that each term is one FMA
        Float i_albedo = {}, i_normal = {}, i_visibility = {};
        if constexpr (Albedo) i_albedo = inverse[m_albedo] * -log2_e;
        if constexpr (Normal) i_normal = inverse[m_normal] * -log2_e;
        if constexpr (Visibility) i_visibility = inverse[m_visibility] * -log2_e;
        // All sums are of differences to the centre: exact where the window is constant.
        Float w_sum = {};
        Three y_sum = {}, z_sum = {}, albedo_sum = {}, normal_sum = {};
        float* kept = scratch;
        for (int dy = -radius; dy <= radius; ++dy) {
            const int first = first_tap(dy, radius);
            const float* p = job.planes + offset + dy * job.row_stride + first;
            for (int dx = first; dx <= radius; dx += every, p += every) {
                const Three d_y = y_c - load3(p + G::y * stride, stride), d_z = z_c - load3(p + G::z * stride, stride);
                const Float log_y = log2_distance(d_y), log_z = log2_distance(d_z);
                Float exponent = log_y * i_y + log_z * i_z;
                Three d_albedo, d_normal;
                if constexpr (Albedo) {
                    d_albedo = albedo_c - load3(p + G::albedo * stride, stride);
                    exponent += squared(d_albedo) * i_albedo;
                }
                if constexpr (Normal) {
                    d_normal = normal_c - load3(p + G::normal * stride, stride);
                    exponent += squared(d_normal) * i_normal;
                }
                if constexpr (Visibility) {
                    const Float d = visibility_c - load(p + G::visibility * stride);
                    exponent += d * d * i_visibility;
                }
                Float w = exp2_nonpositive(exponent);
                if (dx == 0 && dy == 0) w = centre_weight;
                w_sum += w;
                accumulate(y_sum, w, d_y);
                accumulate(z_sum, w, d_z);
                if constexpr (Albedo) accumulate(albedo_sum, w, d_albedo);
                if constexpr (Normal) accumulate(normal_sum, w, d_normal);
                if constexpr (Keep) {
                    store(kept, w);
                    store(kept + lanes, log_y);
                    store(kept + 2 * lanes, log_z);
                    kept += 3 * lanes;
                }
            }
        }
        w_inverse = 1.0f / w_sum;
        for (int k = 0; k < 3; ++k) {
            deviation[k] = z_sum.v[k] * w_inverse;
            if constexpr (Albedo) deviation[G::beta_albedo + k] = albedo_sum.v[k] * w_inverse;
            if constexpr (Normal) deviation[G::beta_normal + k] = normal_sum.v[k] * w_inverse;
            change.v[k] = -y_sum.v[k] * w_inverse;
            for (int b = k; b < G::betas; b += 3) change.v[k] += beta[b] * deviation[b];
            g.v[k] = y_c.v[k] + change.v[k];
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
        const Float weight = load(job.weight + offset);
        const Three target = load3(job.target + offset, stride);
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
        // s_i = sum_k G_k (h_ik - g_k) = G.(y_i - y_c) + (G beta).(z_c - z_i) + ... - s_centre
        const Float s_centre = dot(gradient, change, Float{});
        Three by_z, by_albedo, by_normal;
        for (int k = 0; k < 3; ++k) {
            by_z.v[k] = gradient.v[k] * beta[k];
            if constexpr (Albedo) by_albedo.v[k] = gradient.v[k] * beta[G::beta_albedo + k];
            if constexpr (Normal) by_normal.v[k] = gradient.v[k] * beta[G::beta_normal + k];
        }
        Float sum_y = {}, sum_z = {}, sum_albedo = {}, sum_normal = {}, sum_visibility = {};
        const int radius = job.window / 2, every = job.every;
        const float* kept = scratch;
        for (int dy = -radius; dy <= radius; ++dy) {
            const int first = first_tap(dy, radius);
            const float* p = job.planes + offset + dy * job.row_stride + first;
            for (int dx = first; dx <= radius; dx += every, p += every, kept += 3 * lanes) {
                const Three d_z = z_c - load3(p + G::z * stride, stride);
                Float s = dot(by_z, d_z, dot(gradient, load3(p + G::y * stride, stride) - y_c, -s_centre));
                Three d_albedo, d_normal;
                if constexpr (Albedo) {
                    d_albedo = albedo_c - load3(p + G::albedo * stride, stride);
                    s = dot(by_albedo, d_albedo, s);
                }
                if constexpr (Normal) {
                    d_normal = normal_c - load3(p + G::normal * stride, stride);
                    s = dot(by_normal, d_normal, s);
                }
                const Float t = load(kept) * s;
                sum_y += t * load(kept + lanes);
                sum_z += t * load(kept + 2 * lanes);
                if constexpr (Albedo) sum_albedo += t * squared(d_albedo);
                if constexpr (Normal) sum_normal += t * squared(d_normal);
                if constexpr (Visibility) {
                    const Float d = visibility_c - load(p + G::visibility * stride);
                    sum_visibility += t * (d * d);
                }
            }
        }
        const int betas = job.eq3 ? 0 : G::betas;
        for (int k = 0; k < betas; ++k)
            store_head(k, gradient.v[k % 3] * deviation[k] * (1.0f - beta[k] * beta[k]));
        int m = 0;
        const auto store_gamma = [&](Float sum) {
            store_head(betas + m, -sum * w_inverse * inverse_slope[m]);
            ++m;
        };
        store_gamma(sum_y * (1.0f / log2_e));  // the kept distances are in units of log2
        store_gamma(sum_z * (1.0f / log2_e));
        if constexpr (Albedo) store_gamma(sum_albedo);
        if constexpr (Normal) store_gamma(sum_normal);
        if constexpr (Visibility) store_gamma(sum_visibility);
        store_head(betas + G::gammas, -s_centre * w_inverse * centre_slope);  // h_c = y_c
    }

private:
    // Taps with dx = slope dy (mod every) are taken: a lattice that has the centre and is spread over all rows.
    int first_tap(int dy, int radius) const {
        const int slope = job.every < 4 ? 1 : 2;
        return -radius + (slope * dy + radius + job.every * job.window) % job.every;
    }

    Float head(int k) const {
        const auto& s = job.head_strides;
        return load_strided(job.heads + patch * s[0] + k * s[1] + row * s[2] + x * s[3], s[3], n);
    }

    void store_head(int k, Float value) const {
        const auto& s = job.gradient_strides;
        store_strided(job.heads_gradient + patch * s[0] + k * s[1] + row * s[2] + x * s[3], s[3], n, value);
    }

    const Job& job;
    const std::int64_t stride;
    const std::int64_t patch, row, x;
    const int n;
    float* const scratch;
    std::int64_t offset;
    Three y_c, z_c, albedo_c, normal_c, g, change;
    Float visibility_c, w_inverse, centre_weight, centre_slope;
    Float beta[9], deviation[9], inverse[5], inverse_slope[5];
};

template <bool Albedo, bool Normal, bool Visibility>
void run_row(const Job& job, Mode mode, std::int64_t index, float* scratch) {
    const int patch = int(index / job.height), row = int(index % job.height);
    double sum = 0;
    for (int x = 0; x < job.width; x += lanes) {
        const int n = job.width - x < lanes ? job.width - x : lanes;
        Block<Albedo, Normal, Visibility> block(job, patch, row, x, n, scratch);
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

}  // namespace

namespace selfcorrect {

void SELFCORRECT_ROW(const Job& job, Mode mode, std::int64_t row, float* scratch) {
    static constexpr RowFunction variants[] = {
        run_row<false, false, false>, run_row<true, false, false>, run_row<false, true, false>,
        run_row<true, true, false>,   run_row<false, false, true>, run_row<true, false, true>,
        run_row<false, true, true>,   run_row<true, true, true>,
    };
    variants[job.has_albedo + 2 * job.has_normal + 4 * job.has_visibility](job, mode, row, scratch);
}

}  // namespace selfcorrect
