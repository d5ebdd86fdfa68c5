"""Render, with Mitsuba's LLVM variant, a little of all that the scripts render: exit code 0 where that works.

Both samplers, the path tracer, the AOVs, and surfaces, textures and lights of each kind. An LLVM library that cannot
compile them ends the process; `variants.py` starts it and says what it found.
"""

import argparse
import importlib
import sys
from typing import Any

import mitsuba as mi
import numpy as np

NO_LIBRARY = 3  # exit code


def scene(sampler: str) -> Any:
    """A Cornell box of 4×4 pixels with one of every kind of surface and light that the scripts use."""
    scene = mi.cornell_box()
    scene["sensor"]["film"].update(width=4, height=4, rfilter={"type": "box"})
    scene["sensor"]["sampler"] = {"type": sampler, "sample_count": 1}
    grey = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32)), "raw": True}
    surfaces = {
        "plastic": {"type": "roughplastic", "diffuse_reflectance": grey, "alpha": 0.2},
        "metal": {"type": "roughconductor", "material": "Cu", "alpha": 0.2},
        "mirror": {"type": "conductor", "material": "Ag"},
        "glass": {"type": "dielectric"},
        "bumped": {"type": "bumpmap", "arbitrary": grey, "bsdf": {"type": "diffuse"}},
    }
    for number, (name, bsdf) in enumerate(surfaces.items()):
        place = mi.ScalarTransform4f().translate([0.4 * number - 0.8, -0.5, 0.3]).scale(0.2)
        scene[name] = {"type": "sphere", "to_world": place, "bsdf": bsdf}
    scene["sun"] = {"type": "directional", "direction": [0, -1, -0.2]}
    scene["sky"] = {"type": "constant"}
    return mi.load_dict(scene)


def main() -> int:
    argparse.ArgumentParser(description=__doc__).parse_args()
    try:
        mi.set_variant("llvm_ad_rgb")
    except ImportError as error:
        print(error, file=sys.stderr)
        return NO_LIBRARY
    importlib.import_module("common_random_numbers")  # registers the sampler
    beauty = {"type": "path", "max_depth": 4}
    integrator = mi.load_dict({"type": "aov", "aovs": "albedo:albedo,nn:sh_normal,dd:depth", "beauty": beauty})
    for sampler in ("independent", "common_random_numbers"):
        image = np.array(mi.render(scene(sampler), spp=1, seed=0, integrator=integrator))
        if not image.any():
            raise RuntimeError("expected light, but got a black image")
    return 0


if __name__ == "__main__":
    sys.exit(main())
