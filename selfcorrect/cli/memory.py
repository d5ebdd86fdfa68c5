"""How much memory a frame takes, known from the headers of its files before anything is read.

What is counted is what is held for every pixel; `tests/cli/test_memory.py` holds it against the peak of the real
command.
"""

import argparse
import ctypes
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch

from denoisers.host import FEATURES as DENOISER_FEATURES
from selfcorrect.buffers import FEATURES, INPUTS, MOTION, Buffer
from selfcorrect.cli import flags
from selfcorrect.cli.terminal import log
from selfcorrect.errors import SettingsError
from selfcorrect.exr import channels
from selfcorrect.exr.file import headers
from selfcorrect.exr.header import Header
from selfcorrect.exr.limits import check_alike, stored_bytes
from selfcorrect.files import Sources
from selfcorrect.settings import Settings
from selfcorrect.stages.core.patches import crops

__all__ = [
    "BASE",
    "GIB",
    "Needs",
    "check_compared",
    "fits",
    "fitted",
    "keep_freed",
    "needs",
    "parse_size",
    "reduced",
    "rounded",
    "scratch_within",
]

GIB = 2**30
BASE = 0.35 * GIB
"""The interpreter, torch, the OpenEXR library and OIDN's weights."""

_WORK = 0.6 * GIB  # one strip of tiles in every form, the network's for one batch, and what the allocator keeps
_OIDN = 0.2 * GIB  # its weights and buffers beside the scratch that it is told of
_LEAST_SCRATCH = 0.4 * GIB  # its smallest tile takes 0.34 GiB
_BYTES = {0: 4, 1: 2, 2: 4}  # uint, half, float
_COMPARED = 250  # bytes of a pixel that the metrics take beside the images
_RGB = 12  # bytes of a pixel of three float32 channels
_CANDIDATES = 2  # OIDN's other modes
_MOTIONS = 36  # bytes of a pixel: offsets and whether they are known, to the frames within two and back
_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # of glibc's mallopt()
_SEEN = 8  # bytes of a pixel for each frame around: what its halves have met there
_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


class Needs(NamedTuple):
    """Peak bytes of each stage; those of denoising and of AOVs without what OIDN takes beside its images."""

    read: float
    denoise: float
    correct: float
    aovs: float
    write: float


def parse_size(text: str) -> int:
    """Bytes of a size such as 6G, 5.5G or 800M (binary units).

    >>> parse_size("1.5G") // 2**20
    1536
    """
    found = re.fullmatch(r"(\d{1,18}(?:\.\d{1,18})?)\s*([KMGT]?)(?:i?B)?", text.strip(), re.IGNORECASE)
    if found is None:
        raise SettingsError(f"expected a size such as 6G or 800M, but got {text!r}")
    return int(float(found[1]) * _UNITS[found[2].upper()])


def scratch_within(
    limit: int, sources: Sources, settings: Settings, *, extra: int = 0, shot: bool = False, layers: int = 1
) -> int:
    """Bytes that are left for OIDN beside its images.

    Args:
        limit: bytes to stay within.
        sources: the frame's files.
        settings: of the correction.
        extra: how many images stages need beyond the halves.
        shot: it is one of a shot's, with its neighbours.
        layers: how many view layers are corrected.

    Raises:
        FileError: a file cannot be read.
        FrameError: a file has another size than half a.
        SettingsError: the frame does not fit.
    """
    found = needs(sources, settings, extra=extra, shot=shot, layers=layers)
    needed = _with_denoiser(found)
    stage = max(needed, key=lambda name: needed[name])
    if needed[stage] > limit:
        raise SettingsError(
            f"{sources.a}: expected --maxmem of at least {rounded(needed[stage])} for a frame of this size and these "
            f"channels (most of it to {stage}), but got {limit / GIB:.1f}G"
        )
    return int(limit - max(found.denoise, found.aovs) - _OIDN)


def fitted(
    options: argparse.Namespace,
    maxmem: str | None,
    sources: Sources,
    *,
    extra: int = 0,
    shot: bool = False,
    layers: int = 1,
) -> int | None:
    """Change the settings in ``options`` to what there is room for, and tell of it.

    Returns:
        Bytes that are left for OIDN; None where ``maxmem`` sets no bound.
    """
    if maxmem is None:
        return None
    limit = parse_size(maxmem)
    changes, lines = reduced(limit, sources, flags.settings_of(options), extra=extra, shot=shot, layers=layers)
    for name, value in changes.items():
        setattr(options, name, value)
    for line in lines:
        log(line)
    return scratch_within(limit, sources, flags.settings_of(options), extra=extra, shot=shot, layers=layers)


def fits(
    limit: int, sources: Sources, settings: Settings, *, extra: int = 0, shot: bool = False, layers: int = 1
) -> bool:
    """Whether a frame can be corrected within so many bytes; arguments as for :func:`scratch_within`."""
    return max(_with_denoiser(needs(sources, settings, extra=extra, shot=shot, layers=layers)).values()) <= limit


def reduced(
    limit: int, sources: Sources, settings: Settings, *, extra: int = 0, shot: bool = False, layers: int = 1
) -> tuple[dict[str, Any], list[str]]:
    """What has to change in the settings for a frame to fit, if that is enough, and a line of each.

    Arguments as for :func:`scratch_within`. Further denoised images go first: a shot's neighbours gain more.
    """
    steps: list[dict[str, Any]] = [{}]
    if settings.candidates != "none":
        steps.append({"candidates": "none"})
    if shot:
        steps += [{**steps[-1], "frame_radius": radius} for radius in reversed(range(settings.frame_radius))]
    fitting = (s for s in steps if fits(limit, sources, replace(settings, **s), extra=extra, shot=shot, layers=layers))
    changes = next(fitting, steps[-1])
    lines = {
        "candidates": "no further candidates: --maxmem has no room for them",
        "frame_radius": f"--frame-radius {changes.get('frame_radius')}: --maxmem has no room for more neighbours",
    }
    return changes, [lines[name] for name in changes]


def _with_denoiser(found: Needs) -> dict[str, float]:
    least = _OIDN + _LEAST_SCRATCH
    return dict(found._asdict(), denoise=found.denoise + least, aovs=found.aovs + least if found.aovs else 0.0)


def needs(sources: Sources, settings: Settings, *, extra: int = 0, shot: bool = False, layers: int = 1) -> Needs:
    """What a frame needs, by the headers of all its files.

    ``extra`` images beyond the halves are held as they are and denoised. In a ``shot`` neighbours are held beside it.
    What becomes of each of its view ``layers`` is held until all are written; of a shot, all that is held of one.
    """
    check_alike(sources.paths)
    file, _, layer = sources.a.partition("::")
    parts, stored = headers(file)
    height, width = parts[0].data_window.size
    pixels = height * width
    held = max(map(_with_siblings, sources.paths))
    features = _features(sources, parts, layer or None, (*FEATURES, MOTION) if shot else FEATURES)
    half = pixels * (_RGB + sum(features.values()))
    image = pixels * _RGB
    aids = image * len(features.keys() & DENOISER_FEATURES)
    planes = sum(buffer.channels for buffer in INPUTS if buffer not in FEATURES or buffer.name in features)
    trained = sum((b - t) * (r - x) for t, x, b, r in crops((height, width), settings, torch.Generator())) or pixels
    training = 1.2 * trained * 2 * 4 * (planes + 1)  # of both halves; 1.2: margins
    beyond = extra * image
    further = _CANDIDATES if settings.guard and settings.candidates != "none" else 0
    candidates = 3 * image * further  # of both halves and of their mean
    stored_channels = sum(len(part.channels) for part in parts)
    history = bool(shot and settings.frame_radius and settings.guard)
    judged = 1 + further + history
    evidence = pixels * 8 * (judged + judged * (judged + 1) // 2) if settings.guard else 0
    around = 0.0
    if shot:  # the next frame is read and the last one written meanwhile
        around = half + held + max(stored, half) + 2 * image + 2 * held
        if history:
            kept = 2 * half + 6 * image + 3 * aids + _MOTIONS * pixels  # also what was gathered and denoised again
            around += (2 * settings.frame_radius + 2) * kept + 3 * image
            around += 2 * settings.frame_radius * _SEEN * pixels
        around *= layers
    around += (layers - 1) * (image + (held if _corrects(sources) else 0))
    both, base = 2 * half, BASE + around
    correct = both + 3 * image + max(training, image + evidence) + 2 * beyond + candidates
    return Needs(
        read=base + half + held + max(stored, half) + beyond,
        denoise=base + both + max(image + aids, 2 * image) + image + 2 * beyond + candidates,
        correct=base + _WORK + correct,
        aovs=around + _of_aovs(pixels, stored_channels, half, held) if _corrects(sources) else 0.0,
        write=base + _WORK + 2 * image + 2 * held + max(stored, held),  # both halves, and what is made of them
    )


def _corrects(sources: Sources) -> bool:
    """Whether AOVs are."""
    return sources.aovs not in (None, "none")


def _of_aovs(pixels: int, count: int, half: float, held: float) -> float:
    """At most every channel is of an AOV, each of which is kept in float32, with where it has light, or as written."""
    image = pixels * _RGB
    kept = 1.25 * image * (count / 3)
    working = 12 * image  # denoised halves and their mean, the guides of each, one AOV's evidence
    moving = 7 * image  # the picture that moves, its halves as given and as they move, and those of the sum
    return BASE + _WORK + 2 * half + 4 * image + 2 * held + kept + moving + working


def rounded(size: float) -> str:
    """A size for people, rounded up.

    >>> rounded(1.42 * GIB)
    '1.5G'
    """
    return f"{math.ceil(10 * size / GIB) / 10:.1f}G"


def check_compared(limit: int, paths: Sequence[str]) -> None:
    """Refuse to compare images that do not fit into so many bytes, by their headers.

    Raises:
        FileError: a file is missing or no OpenEXR file.
        SettingsError: they do not fit.
    """
    sizes = [part.data_window.size for part in headers(paths[0].partition("::")[0])[0]]
    pixels = max(height * width for height, width in sizes)
    needed = BASE + pixels * (_RGB * len(paths) + _COMPARED) + max(map(_with_siblings, paths))
    if needed > limit:
        raise SettingsError(
            f"{paths[0]}: expected --maxmem of at least {rounded(needed)} to compare the pixels that the headers "
            f"claim, but got {limit / GIB:.1f}G"
        )


def _with_siblings(path: str) -> int:
    """Bytes of a file and of those beside it, which are held together while one half is read."""
    beside = channels.siblings(path.partition("::")[0]).values()
    return stored_bytes(path) + sum(stored_bytes(str(file)) for file in beside)


def _features(sources: Sources, parts: list[Header], layer: str | None, wanted: tuple[Buffer, ...]) -> dict[str, int]:
    """Bytes of a pixel of each of these buffers of one half, as far as there are."""
    file = sources.a.partition("::")[0]
    named = [(part.name, [channel.name for channel in part.channels]) for part in parts]
    full = [name for names in channels.full_names(named, parts[0].views) for name in names]
    types = dict(zip(full, (channel.type for part in parts for channel in part.channels), strict=True))
    taken = channels.choose(full, file=file, layer=layer, mapping=sources.mapping)
    beside = channels.siblings(file)
    found = {}
    for role in (buffer.name for buffer in wanted):
        if role in taken:
            found[role] = channels.ROLES[role] * max(_BYTES[types[name]] for name in taken[role])
        elif role in beside:
            found[role] = _RGB  # the most it can be: its file is not opened here
    return found


def keep_freed() -> None:
    """Have this process keep what it frees, up to an eighth of a gibibyte, for what it takes next.

    glibc hands a map of some megabytes back to the system as soon as it is let go, and the next one comes in pages that
    the system has to clear: at 8K an eighth of the guard's time. Other C libraries have no such switch.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, 2**25)  # the most that it takes
        mallopt(_TRIM_THRESHOLD, 2**27)
