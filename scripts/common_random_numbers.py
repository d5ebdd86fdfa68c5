"""Mitsuba renders whose pixels all see the same random numbers, and an image from their finite differences.

    python scripts/common_random_numbers.py SCENE.xml -o OUT.exr [--spp 16] [--seed 0] [--poisson] [--independent]

With common random numbers the error of neighbouring pixels is nearly the same, so that their differences are known far
better than their values. ``--poisson`` makes the image whose gradients are nearest to those differences and whose
values are nearest to those of independent samples (L2 screened Poisson; both are rendered). ``cornell-box`` is the
scene that comes with Mitsuba. Needs the extra ``render``.
"""

import argparse
from pathlib import Path
from typing import Any

import drjit
import mitsuba as mi
import numpy as np
from screened_poisson import screened_poisson

mi.set_variant("llvm_ad_rgb")

_SEED = 0x1234567  # any number will do


class CommonRandomNumbers(mi.Sampler):
    """Sample k of every pixel draws the same numbers.

    ``PCG32(size, …)`` gives every lane a stream of its own, so its state and increment are gathered by sample index.
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
        count = self.sample_count()
        lane = mi.UInt32(np.arange(wavefront_size, dtype=np.uint32) % count)
        streams = mi.PCG32(count, initstate=mi.UInt64(seed) + _SEED)
        self.random = mi.PCG32()
        self.random.state = drjit.gather(mi.UInt64, streams.state, lane)
        self.random.inc = drjit.gather(mi.UInt64, streams.inc, lane)

    def next_1d(self, active: Any = True) -> Any:
        """The next number of every lane."""
        return self.random.next_float32(active)

    def next_2d(self, active: Any = True) -> Any:
        """The next two."""
        first = self.next_1d(active)
        return mi.Point2f(first, self.next_1d(active))


mi.register_sampler("common_random_numbers", CommonRandomNumbers)


def load_scene(path: str, *, common: bool, size: int | None = None) -> Any:
    """A scene with a box filter and the sampler wanted; ``cornell-box`` is built in.

    The sampler's plug-in is chosen in the dictionary of the scene, so that only ``cornell-box`` and scenes that name
    the parameter ``sampler`` (``<sampler type="$sampler">``) can be switched.
    """
    name = "common_random_numbers" if common else "independent"
    if path != "cornell-box":
        return mi.load_file(path, sampler=name)
    scene = mi.cornell_box()
    film = scene["sensor"]["film"]
    film.update(width=size or 256, height=size or 256, rfilter={"type": "box"})
    scene["sensor"]["sampler"] = {"type": name, "sample_count": 16}
    return mi.load_dict(scene)


def render(scene: Any, spp: int, seed: int) -> np.ndarray[Any, Any]:
    """Linear radiance, (H, W, 3) float32."""
    return np.array(mi.render(scene, spp=spp, seed=seed))[..., :3]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("-o", "--output", required=True, type=Path)
    parser.add_argument("--spp", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--size", type=int, help="side of cornell-box, pixels")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--independent", action="store_true", help="independent samples instead")
    kind.add_argument("--poisson", action="store_true", help="screened Poisson of both")
    options = parser.parse_args()
    scenes = {common: load_scene(options.scene, common=common, size=options.size) for common in (False, True)}
    image = render(scenes[not options.independent], options.spp, options.seed)
    if options.poisson:
        image = screened_poisson(render(scenes[False], options.spp, options.seed), image)
    mi.Bitmap(image).write(str(options.output))


if __name__ == "__main__":
    main()
