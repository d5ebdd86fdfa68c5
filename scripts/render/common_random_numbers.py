"""A sampler for Mitsuba whose pixels all see the same random numbers; importing it registers it in `llvm_ad_rgb`.

The error of neighbouring pixels is then nearly the same, so that their differences are known far better than their
values. `scripts/render/render_mitsuba.py --crn` renders any scene with it; the Cornell box is here for tests and
`scripts/bench/uncorrelated.py`. Needs the extra ``render``, and an LLVM library.
"""

from typing import Any

import drjit
import mitsuba as mi
import numpy as np

mi.set_variant("llvm_ad_rgb")


class CommonRandomNumbers(mi.Sampler):
    """Sample k of every pixel draws the same numbers.

    Seed and k are hashed together, as Mitsuba's own sampler hashes seed and lane: streams of PCG32 that start at
    consecutive states repeat each other's first numbers three seeds apart. Samples count down from 2³², where lanes are
    not: no pixel of an independent render of the same seed has these numbers.
    """

    def __init__(self, properties: Any = None):
        super().__init__(mi.Properties() if properties is None else properties)
        self.random = mi.PCG32()

    def fork(self) -> "CommonRandomNumbers":
        """A sampler with the same settings, not yet seeded."""
        copy = CommonRandomNumbers()
        copy.set_sample_count(self.sample_count())
        return copy

    def clone(self) -> "CommonRandomNumbers":
        """A sampler in the same state."""
        copy = self.fork()
        copy.random = mi.PCG32(self.random)
        return copy

    def seed(self, seed: int, wavefront_size: int = 0xFFFFFFFF) -> None:
        """Start the streams: one for each sample of a pixel, the same in all pixels."""
        super().seed(seed, wavefront_size)
        sample = drjit.arange(mi.UInt32, wavefront_size) % self.sample_count()
        number = mi.UInt32(seed)
        drjit.make_opaque(number)  # a kernel compiled once for all seeds
        state, sequence = mi.sample_tea_32(number, ~sample)
        self.random.seed(mi.UInt64(state), mi.UInt64(sequence))

    def next_1d(self, active: Any = True) -> Any:
        """The next number of every lane."""
        return self.random.next_float32(active)

    def next_2d(self, active: Any = True) -> Any:
        """The next two."""
        first = self.next_1d(active)
        return mi.Point2f(first, self.next_1d(active))


mi.register_sampler("common_random_numbers", CommonRandomNumbers)


def cornell_box(*, common: bool, size: int) -> Any:
    """Mitsuba's Cornell box of size² pixels, with a box filter and one of both samplers."""
    scene = mi.cornell_box()
    scene["sensor"]["film"].update(width=size, height=size, rfilter={"type": "box"})
    name = "common_random_numbers" if common else "independent"
    scene["sensor"]["sampler"] = {"type": name, "sample_count": 16}
    return mi.load_dict(scene)


def render(scene: Any, spp: int, seed: int) -> np.ndarray[Any, Any]:
    """Linear radiance, (H, W, 3) float32."""
    return np.array(mi.render(scene, spp=spp, seed=seed))[..., :3]
