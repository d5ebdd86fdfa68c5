// What Python calls: checks nothing but types (__init__.py validates), releases the GIL, spreads the rows over threads.

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bindings.h"
#include "job.h"
#include "pool.h"

namespace nb = nanobind;
using nb::ndarray;
using selfcorrect::Job;
using selfcorrect::Mode;
using selfcorrect::RowFunction;

using Array = ndarray<float, nb::device::cpu>;
using Corners = ndarray<std::int64_t, nb::device::cpu, nb::c_contig>;
using Sums = ndarray<double, nb::device::cpu, nb::c_contig>;

namespace {

void run(const Job& job, Mode mode, const std::string& instruction_set, int threads) {
    const RowFunction row = SELFCORRECT_PICK(instruction_set, selfcorrect::row);
    nb::gil_scoped_release release;
    selfcorrect::run_rows(std::int64_t(job.patches) * job.height, threads, selfcorrect::scratch_size(job.window),
                          [&](std::int64_t i, float* scratch) { row(job, mode, i, scratch); });
}

// The arguments that all three functions begin with.
Job make_job(const Array& planes, unsigned present, const Array& heads, const Corners& corners, int window, int every,
             bool eq3) {
    Job job{};
    job.planes = planes.data();
    job.plane_stride = planes.stride(0);
    job.row_stride = planes.stride(1);
    job.present = present;
    job.eq3 = eq3;
    job.window = window;
    job.every = every;
    job.heads = heads.data();
    for (int i = 0; i < 4; ++i) job.head_strides[i] = heads.stride(i);
    job.patches = int(heads.shape(0));
    job.height = int(heads.shape(2));
    job.width = int(heads.shape(3));
    job.corners = corners.data();
    return job;
}

void set_gradient(Job& job, const Array& gradient) {
    job.heads_gradient = gradient.data();
    for (int i = 0; i < 4; ++i) job.gradient_strides[i] = gradient.stride(i);
}

}  // namespace

void bind_cross_bilateral(nb::module_& m) {
    m.def("terms", [] {
        std::vector<std::string> names;
        for (const Term& term : terms) names.push_back(term.name);
        return names;
    });

    m.def("forward",
          [](Array planes, unsigned present, Array heads, Corners corners, int window, int every, bool eq3,
             const std::string& instruction_set, int threads, Array output) {
              Job job = make_job(planes, present, heads, corners, window, every, eq3);
              job.output = output.data();
              run(job, Mode::forward, instruction_set, threads);
          });

    m.def("backward",
          [](Array planes, unsigned present, Array heads, Corners corners, int window, int every, bool eq3,
             const std::string& instruction_set, int threads, Array output_gradient, Array gradient) {
              Job job = make_job(planes, present, heads, corners, window, every, eq3);
              job.output_gradient = output_gradient.data();
              set_gradient(job, gradient);
              run(job, Mode::backward, instruction_set, threads);
          });

    m.def("loss",
          [](Array planes, unsigned present, Array heads, Corners corners, int window, int every, bool eq3,
             const std::string& instruction_set, int threads, Array target, Array weight, Array gradient,
             Sums row_loss) {
              Job job = make_job(planes, present, heads, corners, window, every, eq3);
              job.target = target.data();
              job.weight = weight.data();
              job.row_loss = row_loss.data();
              set_gradient(job, gradient);
              run(job, Mode::loss, instruction_set, threads);
          });
}
