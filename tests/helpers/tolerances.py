"""Tolerances of the tests, the worst case measured beside each; none above ten times it.

Where nothing differs here, another processor may add up in another order: 1e-6 then, eight units of the last place.

Measured on an AVX2 processor over the tests' own cases and one to two more seeds of most. Those of the kernels stand in
``helpers/kernel.py``; bounds that a test explains by itself, such as those of statistics, stand in that test.
"""

# Of a frame's mean: another exposure, all steps of the balanced preset through training and guard. Factors 1e-4 … 1e36.
# Powers of two change no bit.
EXPOSURE_OF_TWO = 1e-7  # 0
EXPOSURE = 5e-5  # 6.6e-6
EXPOSURE_BLEND = 5e-6  # 6.6e-7, the guard's blend from 0 to 1
# Factors below 1e-20, where float32 keeps few digits of the frame or of its products.
EXPOSURE_TINY = 1e-3  # 3.4e-4
EXPOSURE_TINY_BLEND = 5e-4  # 1.1e-4
# Where the convolutions are in bfloat16, an activation may be rounded the other way; factors 1e-40 … 1e36.
EXPOSURE_BF16 = 2e-3  # 3.6e-4
EXPOSURE_BF16_BLEND = 2e-4  # 2.5e-5
SWAPPED = 4e-6  # 5.0e-7 of the mean: half a and half b exchanged

# Eq. 8 through network and kernel in float32 against float64: relative, the gradient to its largest entry.
LOSS = 2e-5  # 4.8e-6
LOSS_GRADIENT = 1e-4  # 5.7e-5
LOSS_GRADIENT_UNSCALED = 1e-3  # 2.7e-4, a firefly that the paper's network sees as it is

EXACT = 2e-14  # 4.9e-15: float64 against float64 by another order of operations, relative
RATE = 2e-7  # 3.6e-8
LOSS_BY_HAND = 1e-6  # 1.0e-7
LIGHT = 1e-6  # 1.3e-7
REGRESSION_EXACT = 5e-5  # 8.0e-6, absolute: what a linear model leaves of a linear target
HALF_MODEL = 2**-11  # 6.4e-5: half floats round by up to this
INTERPRETED_LOSS = 1e-6  # 1.7e-7
SAMPLES = 2e-6  # 2.7e-7
TEMPORAL = 0.019  # 0.00198
STANDARD_ERROR = 0.05  # 0.0057, over 400 draws
SSIM = 4e-6  # 4.6e-7
FLIP = 1e-6  # 1.7e-7
FLIP_EXPOSURE = 5e-7  # 6.8e-8

# Black, a firefly of 1e6 and one of 1e15 through a trained stage's network, to float64: relative to the largest;
# those of bfloat16 by norm, where the gradient of a bias is a sum that nearly cancels.
COMBINER_EXTREME = 5e-6  # 7.4e-7
COMBINER_EXTREME_BF16 = 5e-3  # 7.7e-4
COMBINER_EXTREME_BF16_GRADIENT = 0.5  # 0.22
BILATERAL_EXTREME = 1e-6  # 1.7e-7
BILATERAL_EXTREME_GRADIENT = 2e-5  # 5.2e-6, by norm
BLEND_EXTREME = 1e-4  # 2.8e-5
BLEND_EXTREME_BF16 = 2e-4  # 4.1e-5
BLEND_EXTREME_BF16_GRADIENT = 0.6  # 0.29

_NEAR = {
    # Of single precision, relative and absolute alike: the largest |difference| / (1 + |expected|).
    "joint-bilateral by hand": 1e-6,  # 1.1e-7
    "joint-bilateral keeps light": 1e-6,  # 0 here
    "OIDN and threads": 2e-5,  # 5.4e-6
    "OIDN of the mean": 1e-6,  # 0 here
    "dual keeps what is linear": 5e-7,  # 6.8e-8
    "dual exposure": 1e-5,  # 1.0e-6
    "convolution views": 2e-6,  # 2.8e-7
    "cross-bilateral on others": 2e-6,  # 3.6e-7
    "cross-bilateral in part": 1e-6,  # 0 here
    "nlm in place": 1e-6,  # 2.0e-7
    "combiner and outlier": 5e-6,  # 6.9e-7
    "combiner in bfloat16": 1e-3,  # 1.2e-4
    "neural blend in batches": 1e-6,  # 2.0e-7
    "neural blend in bfloat16": 5e-4,  # 8.3e-5
    "network by hand": 3e-7,  # 4.0e-8
    "paper by hand": 5e-6,  # 6.2e-7
    "regression by hand": 5e-5,  # 5.4e-6
    "Adam": 5e-7,  # 6.2e-8
    "neural blend in tiles": 3e-7,  # 4.1e-8
    "combiner in tiles": 5e-7,  # 9.5e-8
    "trained and exposure": 1e-6,  # 1.5e-7
    "neural by hand": 1e-6,  # 0 here
    "neural blend, flat": 5e-6,  # 6.2e-7
    "combine to file": 1e-6,  # 0 here
    "reference for the kernel": 2e-6,  # 2.8e-7
    "guard in bands": 1e-6,  # 0 here
    "whole frame interpreted": 1e-6,  # 2.6e-7
    "whole frame elsewhere": 2e-6,  # 3.3e-7
}


def near(name: str) -> dict[str, float]:
    """The tolerance of this name, for ``assert_close``."""
    return {"rtol": _NEAR[name], "atol": _NEAR[name]}
