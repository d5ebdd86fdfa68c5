// Python's doors to the kernels that stand beside the cross-bilateral one, each in a file of its own.
#pragma once

#include <nanobind/nanobind.h>

void bind_convolution(nanobind::module_& m);
void bind_nlm(nanobind::module_& m);
void bind_regression(nanobind::module_& m);
