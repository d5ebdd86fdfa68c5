// The extension module: what each kernel's folder binds.

#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bindings.h"
#include "pool.h"

NB_MODULE(_cpu, m) {
    m.def("instruction_sets", &selfcorrect::instruction_sets, "Names this processor can run, slowest first.");
    bind_convolution(m);
    bind_cross_bilateral(m);
    bind_nlm(m);
    bind_regression(m);
}
