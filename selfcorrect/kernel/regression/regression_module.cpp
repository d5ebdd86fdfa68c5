// What Python calls for the windowed regression: checks nothing but types (__init__.py validates), releases the GIL.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include <optional>

#include "bindings.h"
#include "pool.h"
#include "regression.h"

namespace nb = nanobind;
using nb::ndarray;
using selfcorrect::Regression;

using Array = ndarray<float, nb::device::cpu, nb::c_contig>;

namespace {

Regression make_job(const Array& planes, int vectors, int scalars, int radius, int stride, int margin, int height,
                    int width, float ridge, float inverse_bandwidth, const std::optional<Array>& weights,
                    int first_row) {
    Regression job{};
    job.planes = planes.data();
    job.place_stride = planes.stride(0);
    job.plane_stride = planes.stride(1);
    job.row_stride = planes.stride(2);
    job.vectors = vectors;
    job.scalars = scalars;
    job.radius = radius;
    job.stride = stride;
    job.margin = margin;
    job.height = height;
    job.width = width;
    job.ridge = ridge;
    job.inverse_bandwidth = inverse_bandwidth;
    job.first_row = first_row;
    if (weights) {
        job.weights = weights->data();
        job.weight_rows = std::int64_t(weights->shape(1));
        job.weight_columns = std::int64_t(weights->shape(2));
    }
    return job;
}

void run(const Regression& job, selfcorrect::RegressionRow row, int rows, int threads) {
    nb::gil_scoped_release release;
    selfcorrect::run_rows(rows, threads, selfcorrect::regression_scratch,
                          [&](std::int64_t i, float* scratch) { row(job, i, scratch); });
}

}  // namespace

void bind_regression(nb::module_& m) {
    m.def("solve",
          [](Array planes, int vectors, int scalars, int radius, int stride, int margin, int height, int width,
             float ridge, float inverse_bandwidth, std::optional<Array> weights, int first_row, int rows,
             const std::string& instruction_set, int threads, Array models) {
              Regression job = make_job(planes, vectors, scalars, radius, stride, margin, height, width, ridge,
                                        inverse_bandwidth, weights, first_row);
              job.models = models.data();
              run(job, SELFCORRECT_PICK(instruction_set, selfcorrect::solve), rows, threads);
          },
          nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());

    m.def("reconstruct",
          [](Array planes, int vectors, int scalars, int radius, int stride, int margin, int height, int width,
             float ridge, float inverse_bandwidth, std::optional<Array> weights, int first_row, int rows,
             const std::string& instruction_set, int threads, Array centres, Array output) {
              Regression job = make_job(planes, vectors, scalars, radius, stride, margin, height, width, ridge,
                                        inverse_bandwidth, weights, first_row);
              job.centres = centres.data();
              job.centre_plane_stride = centres.stride(0);
              job.centre_row_stride = centres.stride(1);
              job.output = output.data();
              run(job, SELFCORRECT_PICK(instruction_set, selfcorrect::reconstruct), rows, threads);
          },
          nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(),
          nb::arg().none(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg(), nb::arg());
}
