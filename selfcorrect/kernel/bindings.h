// What each kernel's folder binds.
#pragma once

#include <nanobind/nanobind.h>

void bind_convolution(nanobind::module_& m);
void bind_cross_bilateral(nanobind::module_& m);
void bind_nlm(nanobind::module_& m);
void bind_regression(nanobind::module_& m);
