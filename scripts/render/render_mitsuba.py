"""Render the two halves of a frame or a shot with Mitsuba 3, the way selfcorrect wants them.

    python scripts/render/render_mitsuba.py SCENE.xml -o shot --spp 64
    python scripts/render/render_mitsuba.py SCENE.xml -o shot --spp 64 --frames 1-24 -D 'angle={2 * frame}'

It writes ``SCENE_a.####.exr`` and ``SCENE_b.####.exr``, half of the samples and another seed each, with albedo,
shading normal and depth beside the colour; of a shot also the motion to the frames before and after
(``mitsuba_motion.py``), for which the scene is loaded at those frames as well. The scene's integrator, sampler and
camera stay; its pixel filter becomes a box, since a wider one correlates the noise of neighbours, and a film that names
no component format stores float.

``-D NAME=TEXT`` sets a parameter of the scene (``<default name="NAME" value="…"/>``, used as ``$NAME``). Between braces
in TEXT stands arithmetic over the frame number: ``{1.5 + sin(frame / 24)}``, ``wood.{frame:04d}.png``. A scene that
uses ``$frame`` gets the frame number without being asked.

``--crn`` gives every pixel the same random numbers, and ``--poisson`` an image reconstructed from the finite
differences of such a render: what `selfcorrect combine` takes as correlated images.

Needs the extra `render`; the LLVM variants also need the LLVM shared library (`apt-get install libllvm19`, and the
variable DRJIT_LIBLLVM_PATH where it is not found). Without one that renders, `scalar_rgb` does the same, more slowly,
but for common random numbers.
"""

import argparse
import ast
import importlib
import math
import operator
import re
import sys
import time
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from halves import HALVES, add_arguments, path_of, published, seed_of
from mitsuba_motion import CHANNELS, Layout, hits, layout, motion
from screened_poisson import screened_poisson
from variants import LLVM, SCALAR, VariantError, chosen

CRN = "common_random_numbers"  # the sampler, and the script that has it
AOVS = "albedo:albedo,nn:sh_normal,dd:depth"
PATHS_PER_PASS = 2**23
"""More samples are rendered in several passes: the LLVM and CUDA variants hold all paths of one in memory."""

_OPERATORS = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
}
_FUNCTIONS = {name: getattr(math, name) for name in ("sin", "cos", "tan", "sqrt", "exp", "radians", "floor")}


class RenderError(Exception):
    """A scene or a flag that the user can fix; one line."""


def evaluate(expression: str, frame: int) -> float:
    """Value of an arithmetic expression over ``frame`` and ``pi``.

    Raises:
        RenderError: it is anything else.
    """

    def value(node: ast.AST) -> float:
        match node:
            case ast.Constant(value=int() | float() as number):
                return number
            case ast.Name(id="frame"):
                return frame
            case ast.Name(id="pi"):
                return math.pi
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _OPERATORS:
                return _OPERATORS[type(op)](value(left), value(right))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -value(operand)
            case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in _FUNCTIONS:
                return _FUNCTIONS[name](value(argument))
        raise ValueError("not arithmetic")

    try:
        return value(ast.parse(expression.strip(), mode="eval").body)
    except (SyntaxError, ValueError, ArithmeticError):
        raise RenderError(f"expected arithmetic over frame in {{…}}, but got {{{expression}}}") from None


def definitions(texts: list[str], frame: int) -> dict[str, str]:
    """Parameters of the scene at a frame, from the texts of ``-D``."""
    found = {}
    for text in texts:
        name, equals, template = text.partition("=")
        if not name or not equals:
            raise RenderError(f"expected -D NAME=TEXT, but got {text!r}")

        def replaced(match: re.Match[str]) -> str:
            return format(evaluate(match[1], frame), match[2] or "")

        found[name] = re.sub(r"\{([^{}:]*):?([^{}]*)\}", replaced, template)
    return found


def load_scene(
    path: Path, parameters: dict[str, str], size: tuple[int, int] | None = None, sampler: str | None = None
) -> Any:
    """The scene with a box filter and, where they are given, that width and height, and that kind of sampler.

    Raises:
        RenderError: Mitsuba does not take the scene.
    """
    config = mi.parser.ParserConfig(mi.variant())
    mi.file_resolver().prepend(str(path.parent.resolve()))  # where the scene's meshes and textures are
    try:
        state = mi.parser.parse_file(config, str(path), **parameters)
        mi.parser.transform_all(config, state)
        for node in state.nodes:
            if node.type == mi.ObjectType.Film:
                _mend_film(state, node.props, size)
            if sampler is not None and node.type == mi.ObjectType.Sampler:
                node.props.set_plugin_name(sampler)
        scene = mi.parser.instantiate(config, state)
    except RuntimeError as error:
        raise RenderError(f"{path}: {' '.join(str(error).split())}") from None
    scene = scene[0] if isinstance(scene, list) else scene
    if not isinstance(scene, mi.Scene) or not scene.sensors():
        raise RenderError(f"{path}: expected a scene with a sensor, but got none")
    return scene


def _mend_film(state: Any, props: Any, size: tuple[int, int] | None) -> None:
    for key in list(props.keys()):
        value = props[key]
        if (
            isinstance(value, mi.Properties.ResolvedReference)
            and state.nodes[value.index()].type == mi.ObjectType.ReconstructionFilter
        ):
            del props[key]
    props["rfilter"] = mi.load_dict({"type": "box"})
    if "component_format" not in props:
        props["component_format"] = "float32"  # half would turn a firefly into infinity
    if size is not None:
        if "crop_width" in props:
            raise RenderError("expected a film without a crop for --size, but got one; set its size in the scene")
        props["width"], props["height"] = size


def render(scene: Any, spp: int, seed: int, integrator: Any = None) -> Any:
    """One half: a Bitmap of the colour and the AOVs, of ``spp`` samples per pixel.

    Args:
        scene: what :func:`load_scene` returned; its first sensor is the camera.
        spp: samples of this half; samplers of strata may round it up.
        seed: of this half.
        integrator: in place of the scene's own (or of a path tracer, where it has none).
    """
    sensor = scene.sensors()[0]
    beauty = integrator or scene.integrator() or mi.load_dict({"type": "path"})
    aov = mi.load_dict({"type": "aov", "aovs": AOVS, "beauty": beauty})
    width, height = sensor.film().crop_size()
    most = max(1, PATHS_PER_PASS // (width * height))
    passes = np.diff(np.linspace(0, spp, math.ceil(spp / most) + 1).round().astype(int))
    total: Any = 0
    for number, samples in enumerate(passes):
        aov.render(scene, sensor=sensor, seed=seed_of(seed, number, "pass"), spp=int(samples), develop=False)
        bitmap = sensor.film().bitmap()
        total = total + np.array(bitmap, dtype=np.float64) * (samples / spp)
    array = np.array(bitmap, copy=False)
    array[:] = total
    return bitmap


class Motions:
    """Motion of the frames of a shot, and what is known of the frames around.

    Args:
        path: the scene.
        parameters: of a frame.
        size: width and height, where they are given.
        seed: of the samples that say what a pixel shows.
    """

    def __init__(self, path: Path, parameters: Any, size: tuple[int, int] | None, seed: int):
        self._path, self._parameters, self._size, self._seed = path, parameters, size, seed
        self._known: dict[int, tuple[dict[str, str], Layout | None]] = {}

    def of(self, frame: int, scene: Any) -> np.ndarray:
        """The channels of a frame, (H, W, 4), of its loaded scene."""
        self._known = {n: known for n, known in self._known.items() if abs(n - frame) <= 1}
        parameters = self._parameters(frame)
        here = layout(scene)
        self._known[frame] = parameters, here
        if not _takes_one_sample(scene):
            scene = load_scene(self._path, parameters, self._size, "independent")
        met = hits(scene, seed_of(self._seed, frame, "motion"))
        return motion(met, here, (self._layout(frame - 1), self._layout(frame + 1)))

    def _layout(self, frame: int) -> Layout | None:
        """None where the scene cannot be loaded, as beyond the last frame of meshes that were exported one by one."""
        if frame not in self._known:
            try:
                parameters = self._parameters(frame)
                same = [known for other, known in self._known.values() if other == parameters]
                made = same[0] if same else layout(load_scene(self._path, parameters, self._size))
                self._known[frame] = parameters, made
            except RenderError:
                self._known[frame] = {}, None
        return self._known[frame][1]


def _takes_one_sample(scene: Any) -> bool:
    """Whether the sampler does not round one sample up, and mix what a pixel shows."""
    sampler = scene.sensors()[0].sampler()
    sampler.set_sample_count(1)
    return bool(sampler.sample_count() == 1)


def with_channels(bitmap: Any, names: tuple[str, ...], values: np.ndarray) -> Any:
    """A bitmap with further channels, (H, W, len(names))."""
    own = np.array(bitmap, copy=False)
    together = np.concatenate([own, values.astype(own.dtype)], -1)
    known = [field.name for field in bitmap.struct_()]
    return mi.Bitmap(together, mi.Bitmap.PixelFormat.MultiChannel, [*known, *names])


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Render the two halves of a frame or a shot with Mitsuba 3.")
    parser.add_argument("scene", type=Path, metavar="SCENE.xml")
    add_arguments(parser)
    parser.add_argument("-D", "--define", action="append", default=[], metavar="NAME=TEXT", help="'angle={2 * frame}'")
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument("--crn", action="store_true", help="common random numbers: the same sequence in every pixel")
    kind.add_argument("--poisson", action="store_true", help="screened Poisson of independent samples and of --crn's")
    parser.add_argument("--variant", help=f"of Mitsuba (default: {LLVM}, or {SCALAR} where LLVM does not render)")
    return parser.parse_args()


def render_shot(options: argparse.Namespace) -> None:
    """Write both halves of every frame."""
    name = options.name or options.scene.stem
    own = {"frame"} if re.search(r"\$frame\b", options.scene.read_text(encoding="utf-8")) else set()

    def parameters_of(number: int) -> dict[str, str]:
        return dict.fromkeys(own, str(number)) | definitions(options.define, number)

    motions = Motions(options.scene, parameters_of, options.size, options.seed)
    for frame in options.frames or [None]:
        number = 1 if frame is None else frame
        parameters = parameters_of(number)
        kinds = ["independent", CRN] if options.poisson else [CRN] if options.crn else [None]
        scenes = [load_scene(options.scene, parameters, options.size, kind) for kind in kinds]
        moved = None if frame is None else motions.of(frame, scenes[0])
        for half in HALVES:
            started = time.perf_counter()
            seed = seed_of(options.seed, number, half)
            bitmap, *common = (render(scene, options.spp // 2, seed) for scene in scenes)
            if common:
                _reconstruct(bitmap, common[0])
            if moved is not None:
                bitmap = with_channels(bitmap, CHANNELS, moved)
            path = path_of(options.output, name, half, frame)
            with published(path) as temporary:
                bitmap.write(str(temporary))
            print(f"{path}: {options.spp // 2} spp, {time.perf_counter() - started:.1f} s", flush=True)


def _reconstruct(bitmap: Any, common: Any) -> None:
    """Put the screened-Poisson image in place of the colour of independent samples."""
    values, differences = (np.array(image, copy=False) for image in (bitmap, common))
    values[..., :3] = screened_poisson(values[..., :3], differences[..., :3])


def main() -> int:
    options = arguments()
    crn = options.crn or options.poisson
    if options.variant not in (None, *mi.variants()):
        print(
            f"render_mitsuba: error: expected a variant of {mi.variants()}, but got {options.variant!r}",
            file=sys.stderr,
        )
        return 2
    try:
        mi.set_variant(chosen(options.variant, sampler=crn))
        if crn:
            importlib.import_module(CRN)  # registers the sampler in the LLVM variant
        render_shot(options)
    except (RenderError, VariantError, ImportError, OSError) as error:  # ImportError: of CUDA's library
        print(f"render_mitsuba: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
