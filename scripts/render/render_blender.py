"""Render the two halves of a frame or a shot with Blender's Cycles, the way selfcorrect wants them.

With Blender, or with Blender as a Python module (`pip install bpy`)::

    blender -b FILE.blend --python-exit-code 1 --python scripts/render/render_blender.py -- -o shot --spp 128
    python scripts/render/render_blender.py FILE.blend -o shot --spp 128 --frames 1-24

It writes ``FILE_a.####.exr`` and ``FILE_b.####.exr``, multilayer EXR, float, with every pass that the view layers have
on and the denoising passes (albedo, normal, depth) besides. Each half has half of the samples and a seed of its own.
What is changed for the render, and only for it (the file is never saved):

- denoiser off, since selfcorrect denoises each half itself;
- pixel filter: box, since a wider one correlates the noise of neighbours (``--filter keep`` leaves the scene's own);
- adaptive sampling off: it stops where the samples happen to agree, which biases what the halves say of the noise;
- sampling pattern tabulated Sobol, scrambling distance 1: blue noise and shared scrambling tie neighbouring pixels;
- time limit, sample subset, samples per view layer, animated seed: off;
- compositing and sequencer off: halves are corrected first, and composited then;
- of a shot: the pass Vector on, along which its frames help each other. Blender has none with motion blur on.

Light clamping stays as the artist set it.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, os.path.dirname(os.path.abspath(__file__)))

from halves import HALVES, add_arguments, path_of, published, seed_of

CYCLES = {
    "use_denoising": False,
    "use_adaptive_sampling": False,
    "sampling_pattern": "TABULATED_SOBOL",
    "auto_scrambling_distance": False,
    "scrambling_distance": 1.0,
    "time_limit": 0.0,
    "use_sample_subset": False,
    "use_layer_samples": "IGNORE",
    "use_animated_seed": False,
}
RENDER = {
    "use_compositing": False,
    "use_sequencer": False,
    "use_file_extension": True,
    "use_overwrite": True,
    "use_placeholder": False,
    "use_persistent_data": True,  # half b finds the geometry of half a in memory
}
IMAGE = {
    "media_type": "MULTI_LAYER_IMAGE",  # Blender 5; unknown before
    "file_format": "OPEN_EXR_MULTILAYER",
    "color_depth": "32",
    "exr_codec": "ZIP",
    "views_format": "MULTIVIEW",  # both eyes in one file
}


class RenderError(Exception):
    """A scene that the user can fix; one line."""


def _set(target: object, values: dict[str, object]) -> None:
    """Set the properties that this version of Blender has."""
    for name, value in values.items():
        if hasattr(target, name):
            setattr(target, name, value)


def prepare(
    scene: bpy.types.Scene,
    spp: int,
    size: tuple[int, int] | None = None,
    *,
    shot: bool = False,
    keep_filter: bool = False,
) -> None:
    """Set a scene up for halves of ``spp`` samples each; for a ``shot`` also with motion, where Blender has it.

    Raises:
        RenderError: it is not rendered with Cycles.
    """
    if scene.render.engine != "CYCLES":
        raise RenderError(f"expected a scene rendered with Cycles, but got {scene.render.engine}; choose Cycles")
    _set(scene.cycles, CYCLES if keep_filter else CYCLES | {"pixel_filter_type": "BOX"})
    _set(scene.render, RENDER)
    _set(scene.render.image_settings, IMAGE)
    scene.cycles.samples = spp
    scene.driver_remove("cycles.seed")
    if size is not None:
        scene.render.resolution_x, scene.render.resolution_y = size
        scene.render.resolution_percentage = 100
    for layer in scene.view_layers:
        layer.cycles.denoising_store_passes = True
        if shot and not scene.render.use_motion_blur:
            layer.use_pass_vector = True


def render_half(scene: bpy.types.Scene, frame: int, seed: int, path: Path) -> None:
    """Render one half of a frame to a file.

    Raises:
        RenderError: keyframes hold the seed, so both halves would be the same.
    """
    scene.cycles.seed = seed
    scene.frame_set(frame)
    if scene.cycles.seed != seed:
        raise RenderError("expected a seed that can be set, but got one that is animated; delete its keyframes")
    with published(path) as temporary:
        scene.render.filepath = str(temporary.resolve())
        bpy.ops.render.render(write_still=True, scene=scene.name)
        if not temporary.exists():
            raise RenderError(f"{path}: expected Blender to write it, but got nothing; is there a camera?")


def render_shot(options: argparse.Namespace) -> None:
    """Write both halves of every frame."""
    if options.file is not None:
        bpy.ops.wm.open_mainfile(filepath=str(options.file.resolve()))
    scene = _scene(options.scene_name)
    keep_filter = options.filter == "keep"
    prepare(scene, options.spp // 2, options.size, shot=len(options.frames or []) > 1, keep_filter=keep_filter)
    name = options.name or Path(bpy.data.filepath).stem or "untitled"
    for frame in options.frames or [None]:
        number = scene.frame_current if frame is None else frame
        for half in HALVES:
            started = time.perf_counter()
            path = path_of(options.output, name, half, frame)
            render_half(scene, number, seed_of(options.seed, number, half), path)
            print(f"{path}: {options.spp // 2} spp, {time.perf_counter() - started:.1f} s", flush=True)


def _scene(name: str | None) -> bpy.types.Scene:
    if name is not None and name not in bpy.data.scenes:
        raise RenderError(f"expected a scene of {', '.join(bpy.data.scenes.keys())}, but got '{name}'")
    return bpy.context.scene if name is None else bpy.data.scenes[name]


@bpy.app.handlers.persistent  # stays when the file is opened
def _print_samples(stats: str, *_: object) -> None:
    """Progress for whoever reads the output: "Sample 3/16"."""
    if "Sample" in stats:
        print(stats, flush=True)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Render the two halves of a frame or a shot with Blender's Cycles.")
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE.blend", help="left out where Blender has opened it")
    add_arguments(parser)
    parser.add_argument("--filter", choices=("box", "keep"), default="box", help="of pixels; keep: the scene's own")
    parser.add_argument("--scene-name", metavar="SCENE", help="by default the one that was open when it was saved")
    own = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    return parser.parse_args(own)


def main() -> int:
    bpy.app.handlers.render_stats.append(_print_samples)
    try:
        render_shot(arguments())
    except (RenderError, RuntimeError, OSError) as error:  # RuntimeError: what Blender's operators raise
        print(f"render_blender: error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    finally:
        # Blender 4.2 as a module crashes at its end with a handler left
        bpy.app.handlers.render_stats.remove(_print_samples)
    return 0


if __name__ == "__main__":
    sys.exit(main())
