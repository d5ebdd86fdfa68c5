"""Which of a file's other channels are linear in the samples: one table, per renderer, and the rule for the rest.

A channel that is linear in the samples (light, its colour, coverage) is best known from both halves: their mean. What
names things (Cryptomatte, indices), or tells of one surface (depth, position, normal, motion, UV), or counts or squares
(sample counts, variances) has no mean: it stays what half a says, bit by bit.

For a name that no row of :data:`TABLE` knows: whole numbers and Cryptomatte by the file's own list are kept; R, G, B
and A of a pass are a colour, and linear (LPE AOVs have the user's names); all other components are kept.
"""

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from selfcorrect.exr.file import ExrFile, Pixels

__all__ = [
    "DIVIDED",
    "TABLE",
    "Others",
    "Rule",
    "divided",
    "linear_channels",
    "mean_of",
    "means",
    "picture",
    "rgb_passes",
]

Kind = Literal["linear", "kept"]


@dataclass(frozen=True)
class Rule:
    """What the channels of a pass are.

    Attributes:
        name: the pass without its layer, case aside; ``*`` stands for any text without a dot.
        kind: linear in the samples, or kept as half a has it.
        writers: who writes it.
    """

    name: str
    kind: Kind
    writers: str


def _rules(kind: Kind, writers: str, *names: str) -> tuple[Rule, ...]:
    return tuple(Rule(name, kind, writers) for name in names)


TABLE = (
    *_rules("kept", "all that write Cryptomatte", "*crypto*"),
    *_rules("kept", "selfcorrect: what the guard found", "selfcorrect"),
    *_rules("kept", "Blender Cycles", "Depth", "Denoising Depth", "Normal", "Denoising Normal", "Position", "Vector"),
    *_rules("kept", "Blender Cycles", "UV", "IndexOB", "IndexMA", "Object Index", "Material Index"),
    *_rules("kept", "Blender Cycles", "Debug *", "Sample Count", "Render Time", "Volume Majorant", "Guiding *"),
    *_rules("kept", "Mitsuba 3, the prefixes of its documentation", "nn", "sh_normal", "dd", "pos", "uv", "shape*"),
    *_rules("kept", "scripts/render, for Mitsuba", "motion"),
    *_rules("kept", "pbrt-v4", "P", "N", "Ns", "dzdx", "dzdy", "*variance", "u", "v"),
    *_rules("kept", "Arnold", "N_noice", "Z", "Pref", "motionvector", "ID", "AA_*", "cputime", "raycount", "volume_Z"),
    *_rules("kept", "RenderMan", "z", "zfiltered", "zback", "*_mse", "mse", "*_var", "sampleCount", "id", "id2", "__*"),
    *_rules("kept", "RenderMan", "normal*", "Nn", "Ng", "st", "motionBack", "motionFore", "forward", "backward"),
    *_rules("kept", "LuxCore", "*_NORMAL", "POSITION", "*_ID", "SAMPLECOUNT", "CONVERGENCE", "NOISE", "*DEPTH*"),
    *_rules("kept", "V-Ray, Redshift, Karma, Mantra", "*velocity", "*normals", "Pz", "*position", "*depth", "*zdepth"),
    *_rules("linear", "Blender Cycles", "Mist", "AO", "Ambient Occlusion", "Shadow", "*Shadow Catcher"),
    *_rules("linear", "Arnold, LuxCore: coverage", "opacity", "ALPHA", "alpha"),
)
"""The first row that fits decides."""


DIVIDED = (
    ("Diffuse Color", ("Diffuse Direct", "Diffuse Indirect")),
    ("Glossy Color", ("Glossy Direct", "Glossy Indirect")),
    ("Transmission Color", ("Transmission Direct", "Transmission Indirect")),
    ("Subsurface Color", ("Subsurface Direct", "Subsurface Indirect")),
    ("DiffCol", ("DiffDir", "DiffInd")),
    ("GlossCol", ("GlossDir", "GlossInd")),
    ("TransCol", ("TransDir", "TransInd")),
    ("SubsurfaceCol", ("SubsurfaceDir", "SubsurfaceInd")),
)
"""Blender, long names and short: the colour that light is divided by, and the light."""


class Others(NamedTuple):
    """What became of the channels beside the colour: how many are the mean of both halves, are half a's, are AOVs that
    were corrected; and the linear ones that half b lacks.
    """

    mean: int
    kept: int
    corrected: int = 0
    lacking: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """For the log."""
        corrected = f"{self.corrected} corrected, " if self.corrected else ""
        told = [f"other channels: {corrected}{self.mean} the mean of both halves, {self.kept} as in half a"]
        if self.lacking:
            told.append(f"in half a only, and so as in half a: {', '.join(self.lacking)}")
        return told


def linear_channels(file: ExrFile) -> list[str]:
    """Full names of the channels that are linear in the samples."""
    names = file.channel_names
    cryptomatte = _cryptomatte(file)
    colors = set(rgb_passes(names))
    found = []
    for name in names:
        above, _, component = name.rpartition(".")
        pass_ = above.rpartition(".")[2]
        rule = next((rule for rule in TABLE if _fits(rule.name, pass_ or component)), None)
        kind: Kind = "linear" if component.casefold() in "rgba" and (above in colors or component == "A") else "kept"
        if rule is not None:
            kind = rule.kind
        named = any(above.casefold().startswith(start) or f".{start}" in above.casefold() for start in cryptomatte)
        if kind == "linear" and not named and file.pixels(name).dtype.kind == "f":
            found.append(name)
    return found


def rgb_passes(names: Sequence[str]) -> dict[str, tuple[str, str, str]]:
    """Passes with R, G and B, with their layer → the full names of the three; ``""`` stands for bare R, G, B."""
    folded = {name.casefold(): name for name in names}
    found = {}
    for name in names:
        above, dot, component = name.rpartition(".")
        if component.casefold() == "r":
            three = [folded.get(f"{above}{dot}{letter}".casefold()) for letter in "rgb"]
            if all(three):
                found[above] = (str(three[0]), str(three[1]), str(three[2]))
    return found


def picture(names: Sequence[str], color: Sequence[str]) -> tuple[str, ...]:
    """The channels that people look at, where the colour that was read is the noisy one beside them.

    Blender with its own denoiser on writes the render as ``Noisy Image`` and the picture as ``Combined``.

    Returns:
        Full names of R, G, B: those of ``color`` unless there is such a picture.
    """
    above = color[0].rpartition(".")[0]
    layer, _, pass_ = above.rpartition(".")
    if pass_.casefold() == "noisy image":
        wanted = f"{layer}.Combined".removeprefix(".").casefold()
        for pass_name, three in rgb_passes(names).items():
            if pass_name.casefold() == wanted:
                return three
    return tuple(color)


def divided(names: Sequence[str]) -> dict[str, str]:
    """Channels of light that the renderer has divided by a colour, and the channel of that colour: full names."""
    passes = rgb_passes(names)
    folded = {name.casefold(): three for name, three in passes.items()}
    found: dict[str, str] = {}
    for above, three in passes.items():
        layer, dot, pass_ = above.rpartition(".")
        for color, lights in DIVIDED:
            divisor = folded.get(f"{layer}{dot}{color}".casefold())
            if divisor is not None and pass_.casefold() in map(str.casefold, lights):
                found |= dict(zip(three, divisor, strict=True))
    return found


def means(a: ExrFile, b: ExrFile, but: Collection[str]) -> tuple[dict[str, Pixels], Others]:
    """Every channel of half a that is linear in the samples, as the mean of both halves, but some.

    Returns:
        full name → (height, width) array in the type of half a; and what became of all channels beside ``but``.
    """
    there = set(b.channel_names)
    found, lacking = {}, []
    for name in linear_channels(a):
        if name in but:
            continue
        if name not in there or a.pixels(name).shape != b.pixels(name).shape:
            lacking.append(name)
            continue
        found[name] = mean_of(a, b, name)
    kept = sum(name not in found and name not in but for name in a.channel_names)
    return found, Others(len(found), kept, lacking=tuple(lacking))


def mean_of(a: ExrFile, b: ExrFile, name: str) -> Pixels:
    """One channel as the mean of both halves, (height, width) in the type of half a."""
    color = divided(a.channel_names).get(name)
    weights = None if color is None or color not in b.channel_names else (a.pixels(color), b.pixels(color))
    return _mean(a.pixels(name), b.pixels(name), weights)


def _mean(a: Pixels, b: Pixels, weights: tuple[Pixels, Pixels] | None) -> Pixels:
    """Mean of a channel over both halves, in the type of half a; where one of them is not finite, the other.

    ``weights`` are the colours of a pass that the renderer has divided by its colour: what is linear in the samples is
    light times colour, so the colour weighs the halves.
    """
    halves = [half.astype(np.float64) for half in (a, b)]
    shares = [np.ones_like(half) if weights is None else _weight(weights[i]) for i, half in enumerate(halves)]
    shares = [np.where(np.isfinite(half), share, 0.0) for half, share in zip(halves, shares, strict=True)]
    total = shares[0] + shares[1]
    with np.errstate(all="ignore"):
        parts = [np.where(share > 0, half * (share / total), 0.0) for half, share in zip(halves, shares, strict=True)]
        plain = (halves[0] + halves[1]) / 2
        mean = np.where(total > 0, parts[0] + parts[1], np.where(np.isfinite(plain), plain, halves[0]))
        return mean.astype(a.dtype)  # infinite where the type cannot hold it, as a renderer would have written it


def _weight(color: Pixels) -> Pixels:
    weight = color.astype(np.float64)
    return np.where(np.isfinite(weight), np.maximum(weight, 0.0), 0.0)


def _fits(pattern: str, name: str) -> bool:
    return re.fullmatch(re.escape(pattern.casefold()).replace(r"\*", "[^.]*"), name.casefold()) is not None


def _cryptomatte(file: ExrFile) -> set[str]:
    """Beginnings of the passes that the file's own attributes ``cryptomatte/…/name`` call Cryptomatte."""
    found: set[str] = set()
    for part in file.parts:
        attributes: Mapping[str, Any] = part.header
        found |= {
            value.casefold()
            for key, value in attributes.items()
            if re.fullmatch(r"cryptomatte/[^/]+/name", key) and isinstance(value, str) and value
        }
    return found
