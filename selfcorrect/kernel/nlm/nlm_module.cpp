// What Python calls for the non-local means: checks nothing but types (__init__.py validates), releases the GIL.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>

#include "bindings.h"
#include "nlm.h"
#include "pool.h"

namespace nb = nanobind;
using selfcorrect::NonLocal;

using Array = nb::ndarray<float, nb::device::cpu, nb::c_contig>;

namespace {

NonLocal make_job(const Array& planes, int margin, int radius, int width, int first_row, const Array& weights) {
    NonLocal job{};
    job.channels = int(planes.shape(0));
    job.plane_stride = planes.stride(0);
    job.row_stride = planes.stride(1);
    job.margin = margin;
    job.radius = radius;
    job.width = width;
    job.first_row = first_row;
    job.weights = weights.data();
    job.rows = int(weights.shape(1));
    job.weight_columns = std::int64_t(weights.shape(2));
    return job;
}

}  // namespace

void bind_nlm(nb::module_& m) {
    m.def("nlm_weights",
          [](Array guide, Array variance, int margin, int radius, int patch_radius, float k, int width, int first_row,
             const std::string& instruction_set, int threads, Array weights) {
              NonLocal job = make_job(guide, margin, radius, width, first_row, weights);
              job.guide = guide.data();
              job.variance = variance.data();
              job.patch_radius = patch_radius;
              job.k_squared = k * k;
              const auto item = SELFCORRECT_PICK(instruction_set, selfcorrect::weigh);
              nb::gil_scoped_release release;
              selfcorrect::run_rows(std::int64_t(weights.shape(0)), threads, selfcorrect::nlm_scratch(job),
                                    [&](std::int64_t i, float* scratch) { item(job, i, scratch); });
          });

    m.def("nlm_average",
          [](Array values, int margin, int radius, int width, int first_row, const std::string& instruction_set,
             int threads, Array weights, Array output) {
              NonLocal job = make_job(values, margin, radius, width, first_row, weights);
              job.values = values.data();
              job.output = output.data();
              const auto item = SELFCORRECT_PICK(instruction_set, selfcorrect::average);
              nb::gil_scoped_release release;
              selfcorrect::run_rows(job.rows, threads, 1,
                                    [&](std::int64_t i, float* scratch) { item(job, i, scratch); });
          });
}
