"""Render the training set: views of 128×128 pixels of real and procedural scenes, four sub-images and a target each.

    python scripts/train/render_dataset.py SCENES -o dataset --views 1000
    python scripts/train/render_dataset.py SCENES -o dataset --views 1000 --workers 8 --minutes 60

SCENES is a folder with one folder per scene and a scene.xml in each; procedural rooms (`rooms.py`) are added. Cameras,
materials, textures and lights are drawn anew for every view, samples per pixel between 4 and 128, and which two
denoisers beside accurate OIDN denoise it. The target is a render of its own, of ``--target-spp``: its noise must be
less than what a network could gain, or the gain can't be seen in the loss. What a view shows depends on the seed and
its number alone: an interrupted run goes on where it was, several run side by side.

`validation/` has views with two clean references each: from cameras that no training view comes near, in scenes with
their own materials, and in rooms that no training view shows. The scenes' own cameras are kept out of both.

Needs the extra `render` and an LLVM library that renders, see `render_mitsuba.py`. Without one, `scalar_rgb` renders
more slowly, and no view is shown with common random numbers.
"""

import argparse
import importlib
import os
import sys
import time
import zlib
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "render"))

import drjit
import mitsuba as mi
import numpy as np
import torch
from dataset import SUB_IMAGES, View, inputs_of, metadata_of, save, views
from render_mitsuba import CRN, load_scene
from rooms import room
from scene import still_life
from variants import LLVM, SCALAR, VariantError, chosen
from variation import Camera, Variation, original_camera, random_camera, sensor

import denoisers

SIZE = 128
SPP = (4, 8, 16, 24, 32, 48, 64, 96, 128)  # of a frame
PASSES = (64, 8, 1)  # samples of a pass: each number is compiled once for every scene, for 10 s
ACCURATE = "oidn"  # every view has it
EXTRA = {"oidn:none": 0.15, "oidn:fast": 0.15, "joint-bilateral": 0.25, "nlm": 0.15, "nfor": 0.15, CRN: 0.15}
"""Beside it, so many of them, and how likely each is drawn first."""
EXTRAS = 2
ROOMS, VALIDATION_ROOMS = range(10), range(1000, 1002)
STILL_LIFE = "still-life"
VALIDATION_VIEWS = 2  # per scene
VALIDATION = "validation"
_BLOCK = 100  # views
_REAL = 0.55  # of the training views show a real scene
_DEPTH = 12
_CANDIDATES = 3  # cameras for a view
_LIT = 0.5  # of the pixels that see light at 2 samples; no more is asked
_VALIDATION = 7_000_000  # the numbers of validation views begin here


class Job(NamedTuple):
    """What a worker needs to know of a run."""

    scenes: Path
    output: Path
    seed: int
    target_spp: int
    reference_spp: int
    size: int
    variant: str  # of Mitsuba


class Shot(NamedTuple):
    """What a view shows, and how it is rendered."""

    number: int
    scene: str
    camera: Camera
    spp: int  # of the frame
    target_spp: int
    extra: tuple[str, ...]  # denoisers beside accurate OIDN


class Loaded(NamedTuple):
    """A scene in memory."""

    scene: Any
    variation: Variation
    camera: Camera
    up: Any


def real_scenes(scenes: Path) -> list[str]:
    """The names of the scenes with a file."""
    return sorted(path.parent.name for path in scenes.glob("*/scene.xml"))


def validation_names(scenes: Path) -> list[str]:
    """The scenes of the validation views: the real ones, and procedural ones that training does not see."""
    return [*real_scenes(scenes), *(f"room-{number}" for number in VALIDATION_ROOMS), STILL_LIFE]


@cache
def _loaded(scenes: Path, name: str, size: int) -> Loaded:
    if name == STILL_LIFE:
        scene, up = mi.load_dict(still_life(size)), (0, 0, 1)
    elif name.startswith("room-"):
        scene, up = mi.load_dict(room(int(name.removeprefix("room-")), size)), (0, 0, 1)
    else:
        scene, up = load_scene(scenes / name / "scene.xml", {}, (size, size)), (0, 1, 0)
    return Loaded(scene, Variation(scene), original_camera(scene), np.array(up, dtype=float))


@cache
def _sensor(size: int, sampler: str) -> Any:
    return sensor(size, sampler)


@cache
def _integrator() -> Any:
    aovs = "albedo:albedo,nn:sh_normal,dd:depth"
    return mi.load_dict({"type": "aov", "aovs": aovs, "beauty": {"type": "path", "max_depth": _DEPTH}})


@cache
def _denoiser(name: str) -> denoisers.Denoise:
    return denoisers.create(name, threads=1)


@cache
def _reserved(job: Job, name: str) -> tuple[Camera, ...]:
    """The scene's own camera and those of its validation views."""
    place = _loaded(job.scenes, name, job.size)
    cameras = [place.camera]
    for number in range(VALIDATION_VIEWS):
        rng = np.random.default_rng((job.seed, _VALIDATION, zlib.crc32(name.encode()), number))
        cameras.append(random_camera(place.scene, place.camera, place.up, cameras, rng))
    return tuple(cameras)


def rendered(place: Loaded, size: int, spp: int, seed: int, sampler: str = "independent") -> torch.Tensor:
    """Colour, albedo, normal and depth, (size, size, 10), from where the sampler's sensor stands."""
    total: Any = 0.0
    passes, left = [], spp
    for samples in PASSES:
        passes += [samples] * (left // samples)
        left %= samples
    for number, samples in enumerate(passes):
        image = mi.render(
            place.scene, sensor=_sensor(size, sampler), integrator=_integrator(), spp=samples, seed=seed + number
        )
        total = total + np.array(image, dtype=np.float64) * (samples / spp)
    # a sample that the renderer lost takes its pixel with it, as black: one view has five renders, and the others go on
    return torch.from_numpy(np.nan_to_num(np.asarray(total), posinf=0.0, neginf=0.0)).float()


def _chosen_camera(job: Job, place: Loaded, reserved: Sequence[Camera], rng: np.random.Generator) -> Camera:
    """Of a few random cameras with light before them, the one that sees the most edges: a plain wall teaches little."""
    best, camera = -1.0, place.camera
    for _ in range(_CANDIDATES):
        candidate = random_camera(place.scene, place.camera, place.up, reserved, rng)
        Variation.place(_sensor(job.size, "independent"), candidate, place.up)
        pilot = rendered(place, job.size, 2, _seed(rng))
        lit = float((pilot[..., :3].sum(-1) > 0).float().mean())
        edges = min(1.0, 20 * float(pilot[..., 3:9].diff(dim=0).abs().mean()))
        if min(lit / _LIT, 1.0) + edges > best:
            best, camera = min(lit / _LIT, 1.0) + edges, candidate
    Variation.place(_sensor(job.size, "independent"), camera, place.up)
    return camera


def _seed(rng: np.random.Generator) -> int:
    return int(rng.integers(2**31 - 1000))


def scene_of(scenes: Path, seed: int, part: str, number: int) -> str:
    """What a view shows; known before it is made, since a process takes one scene only."""
    if part == VALIDATION:
        return validation_names(scenes)[number // VALIDATION_VIEWS]
    real, rng = real_scenes(scenes), np.random.default_rng((seed, number))
    return str(rng.choice(real)) if real and rng.random() < _REAL else f"room-{rng.choice(ROOMS)}"


def training_view(job: Job, name: str, number: int) -> tuple[View, dict[str, str]]:
    """The view of that number: its camera, materials and lights drawn by it and the seed."""
    rng = np.random.default_rng((job.seed, number, 1))
    spp = int(rng.choice(SPP))  # first: how many numbers a camera takes depends on what rays meet
    drawn = rng.choice(list(EXTRA), EXTRAS, replace=False, p=list(EXTRA.values())).tolist()
    extra = tuple(spec for spec in drawn if spec != CRN or job.variant == LLVM)
    place, reserved = _loaded(job.scenes, name, job.size), _reserved(job, name)
    place.variation.draw(rng)
    camera = _chosen_camera(job, place, reserved, rng)
    return _view(job, place, Shot(number, name, camera, spp, job.target_spp, extra), rng)


def _denoised(
    name: str, noisy: torch.Tensor, albedo: torch.Tensor, normal: torch.Tensor, depth: torch.Tensor
) -> torch.Tensor:
    """Images (N, H, W, 3) denoised; in pairs where the denoiser wants both halves."""
    denoise = _denoiser(name)
    if not denoise.dual:
        clean = dict(zip(("albedo", "normal"), denoise.prefilter(albedo, normal), strict=True))
        return torch.stack([denoise(image, **clean, prefiltered=True) for image in noisy])
    features = {"albedo": (albedo,) * 2, "normal": (normal,) * 2, "depth": (depth[..., None],) * 2}
    images = [z for i in (0, 2, 4) for z in denoise.pair((noisy[i], noisy[i + 1]), **features)]
    return torch.stack([*images, (images[4] + images[5]) / 2])


def _view(job: Job, place: Loaded, shot: Shot, rng: np.random.Generator) -> tuple[View, dict[str, str]]:
    samples = [shot.spp // SUB_IMAGES] * SUB_IMAGES + [shot.target_spp]
    images = torch.stack([rendered(place, job.size, spp, _seed(rng)) for spp in samples])
    color, buffers = images[..., :3].contiguous(), images[:SUB_IMAGES, ..., 3:].mean(0)
    features = tuple(buffers[..., part].contiguous() for part in (slice(3), slice(3, 6), 6))
    noisy = inputs_of(color)
    denoised = {name: _denoised(name, noisy, *features) for name in (ACCURATE, *shot.extra) if name != CRN}
    smooth = _denoised(ACCURATE, color[SUB_IMAGES:], *features)[0]
    if CRN in shot.extra:
        Variation.place(_sensor(job.size, CRN), shot.camera, place.up)
        common = [rendered(place, job.size, shot.spp // SUB_IMAGES, _seed(rng), CRN) for _ in range(SUB_IMAGES)]
        denoised["crn"] = inputs_of(torch.stack(common)[..., :3])
    view = View(f"{shot.number:07d}", shot.scene, shot.spp, color, *features, denoised, smooth)
    facts = {
        "seed": job.seed,
        "number": shot.number,
        "camera": shot.camera,
        "target_spp": shot.target_spp,
        "renderer": f"Mitsuba {mi.__version__}, {job.variant}",
    }
    return view, {name: str(value) for name, value in facts.items()}


def validation_view(job: Job, name: str, number: int) -> tuple[View, dict[str, str]]:
    """A validation view: of a reserved camera, the scene as it is, with two references."""
    which = number % VALIDATION_VIEWS
    rng = np.random.default_rng((job.seed, _VALIDATION, number))
    place = _loaded(job.scenes, name, job.size)
    camera = _reserved(job, name)[1 + which]
    place.variation.restore()
    Variation.place(_sensor(job.size, "independent"), camera, place.up)
    spp = (16, 64)[which % 2]
    extra = ("joint-bilateral", "nfor", "oidn:none")
    view, facts = _view(job, place, Shot(number, name, camera, spp, spp // SUB_IMAGES, extra), rng)
    pair = torch.stack([rendered(place, job.size, job.reference_spp, _seed(rng)) for _ in range(2)])[..., :3]
    smooth = _denoised(ACCURATE, pair.mean(0, keepdim=True), view.albedo, view.normal, view.depth)[0]
    view = exposed(view._replace(reference=pair.contiguous(), smooth=smooth))
    return view, facts | {"reference_spp": str(job.reference_spp)}


def exposed(view: View) -> View:
    """A validation view brought to a mean of 1: the 0.01 of the metric would hide the errors of dark ones."""
    assert view.reference is not None  # they have them
    scale = 1 / float(view.smooth.mean().clamp(min=1e-6))
    return view._replace(
        color=view.color * scale,
        denoised={name: images * scale for name, images in view.denoised.items()},
        reference=view.reference * scale,
        smooth=view.smooth * scale,
    )


def _made(job: Job, part: str, name: str, numbers: list[int]) -> int:
    """Make the files of some views of one scene; runs in a process of its own, and says how many."""
    torch.set_num_threads(1)
    drjit.set_thread_count(1)
    mi.set_variant(job.variant)
    if job.variant == LLVM:
        importlib.import_module(CRN)  # registers the sampler
    for number in numbers:
        started = time.perf_counter()
        view, facts = (validation_view if part == VALIDATION else training_view)(job, name, number)
        save(job.output / part / f"{view.name}.safetensors", view, facts)
        seconds = time.perf_counter() - started
        print(f"{part} {view.name} {view.scene} {view.spp} spp, {seconds:.1f} s", flush=True)
    return len(numbers)


def batches(scenes: Path, seed: int, part: str, numbers: list[int]) -> list[tuple[str, str, list[int]]]:
    """The views in batches of one scene each: of every 100 views, those that show the same."""
    found = []
    for first in range(0, len(numbers), _BLOCK):
        groups: dict[str, list[int]] = {}
        for number in numbers[first : first + _BLOCK]:
            groups.setdefault(scene_of(scenes, seed, part, number), []).append(number)
        found += [(part, name, group) for name, group in groups.items()]
    return found


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Render the training set.")
    parser.add_argument("scenes", type=Path, metavar="SCENES", help="a folder of folders with a scene.xml each")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DATASET")
    parser.add_argument("--views", type=int, default=1000, help="of the training part (default: %(default)s)")
    parser.add_argument("--validation", type=int, help="validation views (default: two of each scene)")
    parser.add_argument(
        "--target-spp", type=int, default=256, help="of a training view's target (default: %(default)s)"
    )
    parser.add_argument("--reference-spp", type=int, default=256, help="of each reference (default: %(default)s)")
    parser.add_argument("--size", type=int, default=SIZE, help="pixels (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes (default: one per core)")
    parser.add_argument(
        "--variant",
        choices=(LLVM, SCALAR),
        help=f"of Mitsuba (default: {LLVM}, or {SCALAR} where LLVM does not render)",
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no view after that")
    return parser.parse_args()


def main() -> int:
    options = arguments()
    try:
        variant = chosen(options.variant)
    except VariantError as error:
        print(f"render_dataset: error: {error}", file=sys.stderr)
        return 2
    spp = options.target_spp, options.reference_spp
    job = Job(options.scenes.resolve(), options.output, options.seed, *spp, options.size, variant)
    all_validation = VALIDATION_VIEWS * len(validation_names(job.scenes))
    validation = all_validation if options.validation is None else min(all_validation, options.validation)
    wanted = {VALIDATION: validation, "train": options.views}
    todo = []
    for part, count in wanted.items():
        (job.output / part).mkdir(parents=True, exist_ok=True)
        there = {int(metadata_of(path)["number"]) for path in views(job.output / part)}
        missing = [number for number in range(count) if number not in there]
        todo += batches(job.scenes, job.seed, part, missing)
    print(f"{sum(len(numbers) for *_, numbers in todo)} of {sum(wanted.values())} views to render", flush=True)
    started, done = time.perf_counter(), 0
    # Spawned, since Dr.Jit's threads don't survive a fork; a new process for each batch, since Dr.Jit compiles into
    # every kernel whatever a process has loaded.
    with ProcessPoolExecutor(options.workers, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        waiting, queue = set(), iter(todo)
        while True:
            in_time = time.perf_counter() - started < 60 * options.minutes
            while in_time and len(waiting) < options.workers and (task := next(queue, None)):
                waiting.add(pool.submit(_made, job, *task))
            if not waiting:
                break
            finished = next(as_completed(waiting))
            waiting.remove(finished)
            done += finished.result()
            hour = done / (time.perf_counter() - started) * 3600
            print(f"{done} views, {hour:.0f} images an hour", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
