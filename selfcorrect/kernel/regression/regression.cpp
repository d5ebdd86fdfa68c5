// Weighted least squares in the window of every centre, and every pixel's mean over the models around it
// (Gu et al. 2022, Eqs. 10-12; Bitterli et al. 2016). Compiled once per instruction set. Everything is in an anonymous
// namespace and uses no standard template, so that no wide instruction can leak into a baseline build.
// reference.py is the readable form.

#include "regression.h"

#include "simd.h"

namespace {

using selfcorrect::Regression;

constexpr float smallest_reach = 1e-24f;  // squared distance below which a feature counts as constant
// Products held in registers at a time: as many as there are registers, with a row and a column of factors.
constexpr int block_rows = lanes == 16 ? 4 : 3, block_columns = lanes == 16 ? 6 : 4;

inline int ceil_div(int a, int b) { return a >= 0 ? (a + b - 1) / b : -(-a / b); }
inline int floor_div(int a, int b) { return -ceil_div(-a, b); }
constexpr int smaller(int a, int b) { return a < b ? a : b; }

typedef double Double __attribute__((vector_size(8 * lanes)));
inline Double widened(Float x) { return __builtin_convertvector(x, Double); }

inline Float square_root(Float x) {
    float lane[lanes];
    store(lane, x);
    for (int i = 0; i < lanes; ++i) lane[i] = __builtin_sqrtf(lane[i]);
    return load(lane);
}

template <int Vectors, int Scalars>
class Model {
public:
    static constexpr int features = 3 * Vectors + Scalars, groups = Vectors + Scalars;
    static constexpr int unknowns = features + 1, columns = unknowns + 3;  // 1, features | targets

    // Centres x .. x + lanes - 1 of row y; those beyond the last column are computed in the padding and not stored.
    Model(const Regression& job, int y, int x, float* scratch)
        : job(job), y(y), x(x), values(scratch), products(values + columns * selfcorrect::regression_chunk * lanes),
          moments(products + unknowns * selfcorrect::regression_chunk * lanes) {
        const float* p = place(0, 0);
        for (int k = 0; k < features; ++k) centre[k] = load(p + k * job.plane_stride);
        for (int g = 0; g < groups; ++g) reach[g] = Float{};
        for (int m = 0; m < unknowns * columns; ++m) store(moments + m * lanes, Float{});
    }

    // Sums of w u_i u_j over the window, u = (1, features - centre's, targets).
    void gather() {
        int tap = 0;
        for (int dy = -job.radius; dy <= job.radius; ++dy) {
            for (int first = -job.radius; first <= job.radius; first += selfcorrect::regression_chunk) {
                const int count = smaller(selfcorrect::regression_chunk, job.radius + 1 - first);
                for (int i = 0; i < count; ++i) read(dy, first + i, tap++, i);
                blocks<0, 0>(count);
            }
        }
    }

    // In double precision: where features are nearly one another's combinations, the ridge alone bounds a pivot from
    // below, and rounding to float would be 1 / ridge times as large in the slopes.
    void solve() {
        // Scaled to a mean over the window and to features of at most 1, so that the ridge means the same everywhere.
        const Double share = 1.0 / widened(maximum(moment(0, 0), splat(1e-30f)));
        Double scale[unknowns];
        scale[0] = 1.0 - Double{};
        for (int k = 0; k < features; ++k) {
            const Float r = reach[k < 3 * Vectors ? k / 3 : k - 2 * Vectors];
            const Float inverse = 1.0f / square_root(maximum(r, splat(smallest_reach)));
            scale[k + 1] = widened(r > smallest_reach ? inverse : Float{});
        }
        const Double ridge = double(job.ridge) - Double{};
        Double lower[unknowns][unknowns], pivot[unknowns], inverse[unknowns];
        for (int j = 0; j < unknowns; ++j) {  // L D L^T
            for (int i = j; i < unknowns; ++i) {
                Double a = widened(moment(j, i)) * share * scale[i] * scale[j];
                if (i == j && j > 0) a += ridge;
                for (int k = 0; k < j; ++k) a -= lower[i][k] * lower[j][k] * pivot[k];
                if (i == j) {
                    pivot[j] = a > ridge ? a : ridge;  // it is no less but for rounding of the moments
                    inverse[j] = 1.0 / pivot[j];
                } else {
                    lower[i][j] = a * inverse[j];
                }
            }
        }
        for (int channel = 0; channel < 3; ++channel) {
            Double b[unknowns];
            for (int i = 0; i < unknowns; ++i) {
                b[i] = widened(moment(i, unknowns + channel)) * share * scale[i];
                for (int k = 0; k < i; ++k) b[i] -= lower[i][k] * b[k];
            }
            for (int i = 0; i < unknowns; ++i) b[i] *= inverse[i];
            for (int i = unknowns - 1; i >= 0; --i) {
                for (int k = i + 1; k < unknowns; ++k) b[i] -= lower[k][i] * b[k];
            }
            for (int i = 0; i < unknowns; ++i)
                write(channel * unknowns + i, __builtin_convertvector(b[i] * scale[i], Float));
        }
    }

private:
    const float* place(int dy, int dx) const {
        const int cell_y = floor_div(dy, job.stride), cell_x = floor_div(dx, job.stride);
        const int within = (dy - cell_y * job.stride) * job.stride + dx - cell_x * job.stride;
        return job.planes + within * job.place_stride + (y + cell_y + job.margin) * job.row_stride + x + cell_x +
               job.margin;
    }

    Float moment(int row, int column) const { return load(moments + (row * columns + column) * lanes); }

    void write(int plane, Float value) const {
        float* out = job.models + (std::int64_t(plane) * job.height + y) * job.width + x;
        const int n = smaller(lanes, job.width - x);
        for (int i = 0; i < n; ++i) out[i] = value[i];
    }

    // Values of one tap, and their products with its weight.
    void read(int dy, int dx, int tap, int i) {
        const float* p = place(dy, dx);
        Float u[columns];
        u[0] = splat(1.0f);
        for (int k = 0; k < features; ++k) u[k + 1] = load(p + k * job.plane_stride) - centre[k];
        for (int k = 0; k < 3; ++k) u[unknowns + k] = load(p + (features + k) * job.plane_stride);
        Float first = {};
        for (int g = 0; g < groups; ++g) {
            Float squared = {};
            if (g < Vectors) {
                for (int k = 0; k < 3; ++k) squared += u[3 * g + k + 1] * u[3 * g + k + 1];
            } else {
                squared = u[2 * Vectors + g + 1] * u[2 * Vectors + g + 1];
            }
            if (g == 0) first = squared;
            reach[g] = maximum(reach[g], squared);
        }
        Float w;
        if (job.weights) {
            w = load(job.weights + (tap * job.weight_rows + y - job.first_row) * job.weight_columns + x);
        } else {
            w = exp2_nonpositive(first * -job.inverse_bandwidth);
        }
        for (int k = 0; k < columns; ++k) store(values + (i * columns + k) * lanes, u[k]);
        for (int k = 0; k < unknowns; ++k) store(products + (i * unknowns + k) * lanes, w * u[k]);
    }

    // The upper triangle of the moments, block by block.
    template <int Row, int Column>
    void blocks(int count) {
        constexpr int rows = smaller(block_rows, unknowns - Row), wide = smaller(block_columns, columns - Column);
        Float sum[rows][wide] = {};  // of this chunk alone: summing in two levels loses less to rounding
        for (int i = 0; i < count; ++i) {
            const float* u = values + (i * columns + Column) * lanes;
            const float* wu = products + (i * unknowns + Row) * lanes;
            Float factor[rows];
            for (int r = 0; r < rows; ++r) factor[r] = load(wu + r * lanes);
            for (int c = 0; c < wide; ++c) {
                const Float value = load(u + c * lanes);
                for (int r = 0; r < rows; ++r) sum[r][c] += factor[r] * value;
            }
        }
        for (int r = 0; r < rows; ++r)
            for (int c = 0; c < wide; ++c)
                store(moments + ((Row + r) * columns + Column + c) * lanes, moment(Row + r, Column + c) + sum[r][c]);
        if constexpr (Column + wide < columns)
            blocks<Row, Column + wide>(count);
        else if constexpr (Row + rows < unknowns)
            blocks<Row + rows, Row + rows>(count);
    }

    const Regression& job;
    const int y, x;
    float *const values, *const products, *const moments;
    Float centre[features], reach[groups];
};

template <int Vectors, int Scalars>
void solve_row(const Regression& job, std::int64_t row, float* scratch) {
    for (int x = 0; x < job.width; x += lanes) {
        Model<Vectors, Scalars> model(job, int(row), x, scratch);
        model.gather();
        model.solve();
    }
}

// Pixels of one place in the cells x .. x + lanes - 1: the mean of what the models around them say.
template <int Vectors, int Scalars>
void reconstruct_block(const Regression& job, int place, int y, int x) {
    constexpr int features = 3 * Vectors + Scalars, unknowns = features + 1;
    const int place_y = place / job.stride, place_x = place % job.stride;
    const float* own = job.planes + place * job.place_stride + (y + job.margin) * job.row_stride + x + job.margin;
    Float f[features];
    for (int k = 0; k < features; ++k) f[k] = load(own + k * job.plane_stride);
    const int top = ceil_div(place_y - job.radius, job.stride), bottom = floor_div(place_y + job.radius, job.stride);
    const int left = ceil_div(place_x - job.radius, job.stride), right = floor_div(place_x + job.radius, job.stride);
    const auto model_at = [&](int q, int r) {
        return job.centres + (y + q + job.margin) * job.centre_row_stride + x + r + job.margin;
    };
    const auto squared_distance = [&](const float* centre) {
        Float squared = {};
        for (int k = 0; k < (Vectors ? 3 : 1); ++k) {
            const Float d = f[k] - load(centre + k * job.centre_plane_stride);
            squared += d * d;
        }
        return squared;
    };
    const std::int64_t to_features = 3 * unknowns * job.centre_plane_stride;
    // A pixel that is like no centre takes the models of the least unlike ones; a pixel that is a centre has itself.
    Float nearest = {};
    if (!job.weights && job.stride > 1) {
        nearest = splat(3e38f);
        for (int q = top; q <= bottom; ++q)
            for (int r = left; r <= right; ++r) nearest = minimum(nearest, squared_distance(model_at(q, r) + to_features));
    }
    Float sum[3] = {}, weight_sum = {};
    const int side = 2 * job.radius + 1;
    for (int q = top; q <= bottom; ++q) {
        for (int r = left; r <= right; ++r) {
            const float* model = model_at(q, r);
            const float* centre = model + to_features;
            Float difference[features];
            for (int k = 0; k < features; ++k) difference[k] = f[k] - load(centre + k * job.centre_plane_stride);
            Float w;
            if (job.weights) {
                const std::int64_t tap = (q + job.radius) * side + r + job.radius;
                w = load(job.weights + (tap * job.weight_rows + y - job.first_row) * job.weight_columns + x);
            } else {
                w = exp2_nonpositive((nearest - squared_distance(centre)) * job.inverse_bandwidth);
            }
            for (int channel = 0; channel < 3; ++channel) {
                Float value = load(model);
                model += job.centre_plane_stride;
                for (int k = 0; k < features; ++k, model += job.centre_plane_stride)
                    value += load(model) * difference[k];
                sum[channel] += w * value;
            }
            weight_sum += w;
        }
    }
    const Float share = 1.0f / maximum(weight_sum, splat(1e-30f));
    const int n = smaller(lanes, job.width - x);
    for (int channel = 0; channel < 3; ++channel) {
        const Float mean = sum[channel] * share;
        float* out = job.output + ((std::int64_t(place) * 3 + channel) * job.height + y) * job.width + x;
        for (int i = 0; i < n; ++i) out[i] = mean[i];
    }
}

template <int Vectors, int Scalars>
void reconstruct_row(const Regression& job, std::int64_t row, float*) {
    for (int place = 0; place < job.stride * job.stride; ++place)
        for (int x = 0; x < job.width; x += lanes)
            reconstruct_block<Vectors, Scalars>(job, place, int(row), x);
}

}  // namespace

namespace selfcorrect {

#define SELFCORRECT_TABLE(row)                                                                          \
    static constexpr RegressionRow table[4][3] = {{nullptr, row<0, 1>, row<0, 2>},                       \
                                                  {row<1, 0>, row<1, 1>, row<1, 2>},                     \
                                                  {row<2, 0>, row<2, 1>, row<2, 2>},                     \
                                                  {row<3, 0>, row<3, 1>, row<3, 2>}}

void SELFCORRECT_VARIANT(solve)(const Regression& job, std::int64_t row, float* scratch) {
    SELFCORRECT_TABLE(solve_row);
    table[job.vectors][job.scalars](job, row + job.first_row, scratch);
}

void SELFCORRECT_VARIANT(reconstruct)(const Regression& job, std::int64_t row, float* scratch) {
    SELFCORRECT_TABLE(reconstruct_row);
    table[job.vectors][job.scalars](job, row + job.first_row, scratch);
}

}  // namespace selfcorrect
