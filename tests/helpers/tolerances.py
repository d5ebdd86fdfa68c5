"""Tolerances of exposure, swapped halves and the loss, the worst case measured beside each; none above ten times it.

Measured on an AVX2 processor over the tests' own cases and one to two more seeds of most. Bounds of other tests stand
in those tests.
"""

# Of a frame's mean: another exposure, all steps of the balanced preset through training and guard. Factors 1e-4 … 1e36.
EXPOSURE = 5e-5  # 6.3e-6
EXPOSURE_BLEND = 5e-6  # 6.6e-7, the guard's blend from 0 to 1
# Factors below 1e-20, where float32 keeps few digits of the frame or of its products.
EXPOSURE_TINY = 1e-3  # 3.4e-4
EXPOSURE_TINY_BLEND = 5e-4  # 1.1e-4
SWAPPED = 4e-6  # 5.0e-7 of the mean: half a and half b exchanged

# Eq. 8 through network and kernel in float32 against float64: relative, the gradient to its largest entry.
LOSS = 2e-5  # 4.8e-6
LOSS_GRADIENT = 1e-4  # 5.7e-5
LOSS_GRADIENT_UNSCALED = 1e-3  # 2.7e-4, a firefly that the paper's network sees as it is
