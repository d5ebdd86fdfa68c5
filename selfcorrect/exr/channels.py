"""Which EXR channel is what, per renderer: one table, and the look-ups that read it.

A channel's full name reads ``layer.pass.component``, as in ``ViewLayer.Denoising Albedo.R``; layer and
pass may be missing (``R``, ``albedo.R``). :data:`TABLE` lists, per role and in order of preference, the
passes that renderers write. Upper and lower case count as the same: renderers do not agree on it.

Colour decides the layer: every other role is looked for beside the colour, then in the layers around it,
and never in another view layer. A grey image (``Y`` alone) has no colour pass: the three channels that come
out could not go back into one.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from selfcorrect.buffers import COLOR, FEATURES, MOTION
from selfcorrect.errors import ChannelError, SettingsError
from selfcorrect.exr import motion

__all__ = [
    "LAYOUTS",
    "ROLES",
    "TABLE",
    "choose",
    "full_names",
    "layers",
    "listed",
    "sibling_channels",
    "siblings",
]

ROLES = {buffer.name: buffer.channels for buffer in (COLOR, *FEATURES)} | {"alpha": 1, MOTION.name: MOTION.channels}
"""Every role and its number of channels; motion may come as two (:mod:`selfcorrect.exr.motion`)."""

_RGB = (".R", ".G", ".B")
_XYZ = (".X", ".Y", ".Z")
_BARE_RGB = ("R", "G", "B")
_BARE_XYZ = ("X", "Y", "Z")
_ANY_VECTOR = (_XYZ, _RGB)
_SCALAR = ((".Z",), (".V",), (".T",), (".Y",), (".R",), (".X",), ("",))


@dataclass(frozen=True)
class Pass:
    """One pass of a renderer: the role it plays and the channel names it has.

    Attributes:
        role: a key of :data:`ROLES`.
        name: the pass; ``*`` stands for any text without a dot.
        components: endings that make full channel names, the alternatives in order of preference.
        writers: who writes it.
    """

    role: str
    name: str
    components: tuple[tuple[str, ...], ...]
    writers: str


TABLE = (
    Pass("color", "", (_BARE_RGB,), "Mitsuba 3, pbrt-v4, Arnold, and all that write one file per buffer"),
    Pass("color", "Noisy Image", (_RGB,), "Blender Cycles with its own denoiser on"),
    Pass("color", "Beauty", (_RGB,), "V-Ray, Redshift and most compositing packages"),
    Pass("color", "Combined", (_RGB,), "Blender Cycles; Composite.Combined is its composite, taken last"),
    Pass("color", "RGBA", (_RGB,), "Arnold, multi-part files of compositing packages"),
    Pass("color", "Ci", (_RGB,), "RenderMan"),
    Pass("color", "C", (_RGB,), "Karma, Mantra"),
    Pass("albedo", "Denoising Albedo", (_RGB,), "Blender Cycles"),
    Pass("albedo", "albedo", (_RGB,), "Mitsuba 3, pbrt-v4 (Albedo), LuxCore (ALBEDO), RenderMan"),
    Pass("albedo", "denoise_albedo", (_RGB,), "Arnold"),
    Pass("albedo", "diffuse_albedo", (_RGB,), "Arnold"),
    Pass("albedo", "DiffCol", (_RGB,), "Blender Cycles"),
    Pass("albedo", "Diffuse Color", (_RGB,), "Blender Cycles"),
    Pass("albedo", "alb", (_RGB,), "Mitsuba 3, a usual prefix"),
    Pass("albedo", "*albedo", (_RGB,), "Mitsuba 3, the user's prefix"),
    Pass("normal", "Denoising Normal", _ANY_VECTOR, "Blender Cycles"),
    Pass("normal", "nn", (_XYZ,), "Mitsuba 3, the prefix of its documentation"),
    Pass("normal", "Ns", (_XYZ, _BARE_XYZ), "pbrt-v4; Nsx in its older versions"),
    Pass("normal", "N", (*_ANY_VECTOR, _BARE_XYZ), "Arnold, pbrt-v4; Nx in its older versions"),
    Pass("normal", "N_noice", _ANY_VECTOR, "Arnold"),
    Pass("normal", "AVG_SHADING_NORMAL", _ANY_VECTOR, "LuxCore"),
    Pass("normal", "Normal", _ANY_VECTOR, "Blender Cycles, RenderMan (normal)"),
    Pass("normal", "sh_normal", (_XYZ,), "Mitsuba 3, the name of the AOV itself"),
    Pass("normal", "*normal", _ANY_VECTOR, "Mitsuba 3, the user's prefix"),
    Pass("depth", "Denoising Depth", _SCALAR, "Blender Cycles"),
    Pass("depth", "Depth", _SCALAR, "Blender Cycles (Depth.Z or Depth.V), LuxCore (DEPTH), Tungsten"),
    Pass("depth", "*", ((".T",), (".y.T",)), "Mitsuba 3: only its depth has a T, whatever the prefix"),
    Pass("depth", "Z", _SCALAR, "Arnold, RenderMan (z)"),
    Pass("depth", "zfiltered", _SCALAR, "RenderMan"),
    Pass("depth", "P", ((".Z",),), "pbrt-v4"),
    Pass("visibility", "visibility", _SCALAR, "Tungsten, reference implementation"),
    Pass("alpha", "", (("A",),), "all of them; RenderMan writes a"),
    Pass("alpha", "Combined", ((".A",),), "Blender Cycles, whose Noisy Image may lack it"),
    *(Pass(MOTION.name, row.name, row.components, row.writer) for row in motion.CONVENTIONS if row.found),
)


@dataclass(frozen=True)
class Layout:
    """A renderer that writes one file per buffer: the word in a file's name that says which buffer it holds.

    Attributes:
        writer: who writes it.
        color: the words of the colour file; the half's letter A or B may follow.
        files: the word that takes its place, per role.
    """

    writer: str
    color: tuple[str, ...]
    files: Mapping[str, str]


LAYOUTS = (
    Layout(
        "reference implementation",
        ("randImg",),
        {"albedo": "albedo", "normal": "normal", "visibility": "visibility", "denoised": "denoImg"},
    ),
    Layout(
        "Tungsten",
        ("color",),
        {"albedo": "albedo", "normal": "normal", "depth": "depth", "visibility": "visibility"},
    ),
    Layout(
        "LuxCore",
        ("RGB", "RGBA", *(f"RGB{a}_IMAGEPIPELINE{number}" for a in ("", "A") for number in ("", "_0"))),
        {"albedo": "ALBEDO", "normal": "AVG_SHADING_NORMAL", "depth": "DEPTH"},
    ),
)


def full_names(parts: Sequence[tuple[str, Sequence[str]]], views: Sequence[str] = ()) -> list[list[str]]:
    """Full names of the channels: ``part.channel`` where the channel alone does not say its pass.

    Blender 5 names a part ``ViewLayer.Combined`` (``ViewLayer.Combined-left`` for one eye) and its channels
    ``ViewLayer.Combined.R``, which is full already; other packages name them ``R``. The name of the only part
    of a file says nothing about its channels.

    Where there are several views, each is a layer around all of its own: ``left.ViewLayer.Combined.R``, for which
    Blender 4 writes ``ViewLayer.Combined.left.R``.

    Args:
        parts: name and channel names of each part.
        views: the views that the file names (its attribute ``multiView``).

    Returns:
        The full names in the same order, each only once in the file.
    """
    split = [[_view(channel, part, views) for channel in channels] for part, channels in parts]
    several = len({*views, *(view for names in split for view, _ in names if view)}) > 1
    taken: set[str] = set()
    full = []
    for (part, channels), seen in zip(parts, split, strict=True):
        names = []
        for channel, (view, plain) in zip(channels, seen, strict=True):
            complete = len(parts) == 1 or not part or _starts_with_pass(channel, part)
            name = f"{view}.{plain}" if several and view else plain
            name = name if complete and name not in taken else f"{part}.{channel}"
            taken.add(name)
            names.append(name)
        full.append(names)
    return full


def _view(channel: str, part: str, views: Sequence[str]) -> tuple[str, str]:
    """The view of a channel, empty where none is named, and the channel's name without it."""
    above, _, component = channel.rpartition(".")
    if above and part.startswith(f"{above}-"):
        return part.removeprefix(f"{above}-"), channel
    around, _, word = above.rpartition(".")
    if word in views:
        return word, f"{around}.{component}" if around else component
    return "", channel


def _starts_with_pass(channel: str, part: str) -> bool:
    above = channel.rpartition(".")[0]
    return channel.startswith(f"{part}.") or (above != "" and (part == above or part.startswith(f"{above}-")))


def layers(names: Sequence[str]) -> list[str]:
    """Layers that hold a colour pass, in the order they are taken when none is named.

    ``""`` stands for colour without a layer and comes first; Blender's ``Composite`` comes last; the others
    keep the order of the file.
    """
    found: dict[str, None] = {}
    for name in names:
        for entry in _entries("color"):
            first = f"{entry.name}{entry.components[0][0]}".casefold()
            layer = name[: -len(first) - 1] if name.casefold().endswith(f".{first}") else ""
            bare = name.casefold() == first
            if (bare or (layer and entry.name)) and _find(_inside(names, layer), entry):
                found.setdefault(layer)
    return sorted(found, key=lambda layer: (layer != "", layer.casefold() == "composite"))


def choose(
    names: Sequence[str], *, file: str, layer: str | None = None, mapping: Mapping[str, str] | None = None
) -> dict[str, tuple[str, ...]]:
    """Choose the channels of each role.

    Args:
        names: full channel names, in the order of the file (see :func:`full_names`).
        file: what messages call the file.
        layer: the layer to take, or a view, for its first layer; None takes the first of :func:`layers`, or,
            where no known pass is found, the only pass with R, G, B that plays no other role (Mitsuba's
            ``<image>.R``).
        mapping: role → name of the user's own pass (``albedo`` → ``my_aov``), of one channel, or of several
            channels with commas between them.

    Returns:
        role → channel names, as many as :data:`ROLES` says; roles that the file does not hold are left out,
        except ``color``.

    Raises:
        ChannelError: there is no colour, no such layer, or a name of ``mapping`` is not in the file.
        SettingsError: ``mapping`` holds a role that does not exist.
    """
    mapping = mapping or {}
    for role in mapping:
        if role not in ROLES:
            raise SettingsError(f"expected a role of {', '.join(ROLES)} in the channel map, but got '{role}'")
    taken = {role: _named(names, role, name, layer, file) for role, name in mapping.items()}
    if "color" not in taken:
        taken["color"] = _color(names, layer, file)
    for role in ROLES:
        if role not in taken and (found := _beside(names, taken["color"][0], role)):
            taken[role] = found
    return {role: taken[role] for role in ROLES if role in taken}


def siblings(path: str | Path) -> dict[str, Path]:
    """Files beside a colour file that hold the other buffers of the same half.

    ``X_randImgA.exr`` has ``X_albedoA.exr``; ``colorB.exr`` has ``albedoB.exr`` or, where both halves share
    it, ``albedo.exr``; ``shot_RGB.0001.exr`` has ``shot_ALBEDO.0001.exr`` (see :data:`LAYOUTS`).

    Returns:
        role → file, for the files that exist; besides the roles of :data:`ROLES` there is ``denoised``, the
        denoised half. Empty for a file whose name fits no layout.
    """
    path, end = Path(path), Path(path).suffix
    for layout in LAYOUTS:
        words = "|".join(sorted(map(re.escape, layout.color), key=len, reverse=True))
        match = re.fullmatch(rf"(|.*[_.\-])(?:{words})([AB]?)(|[_.\-].*)", path.stem)
        if match is None:
            continue
        head, half, tail = match.groups()
        found = {}
        for role, word in layout.files.items():
            own, common = (path.with_name(f"{head}{word}{letter}{tail}{end}") for letter in (half, ""))
            if os.path.isfile(own) or os.path.isfile(common):
                found[role] = own if os.path.isfile(own) else common
        if found:
            return found
    return {}


def sibling_channels(names: Sequence[str], role: str, *, file: str) -> tuple[str, ...]:
    """Channels to take from a file that holds one buffer only.

    Colours and vectors are the pass of that role, else ``R G B``, else ``X Y Z``; depth and visibility are
    the first channel (``R`` of ``R G B``, as the reference implementation has it).

    Raises:
        ChannelError: the file has no such channels.
    """
    if ROLES.get(role, 3) == 1:
        first = next((name for letter in "RX" for name in names if name.rpartition(".")[2] == letter), None)
        return (first or names[0],)
    bare = [Pass(role, "", (_BARE_RGB, _BARE_XYZ), ""), Pass(role, "*", _ANY_VECTOR, "")]
    for entry in [*_entries(role), *bare]:
        if found := _find(_inside(names, ""), entry):
            return found
    raise ChannelError(f"{file}: expected {role} channels R, G, B or X, Y, Z, but got {listed(names)}")


def _entries(role: str) -> Iterator[Pass]:
    return (entry for entry in TABLE if entry.role == role)


def _inside(names: Sequence[str], layer: str) -> dict[str, str]:
    """Names of a layer without the layer, in lower case → full names."""
    start = f"{layer}.".casefold() if layer else ""
    inside: dict[str, str] = {}
    for name in names:
        if name.casefold().startswith(start):
            inside.setdefault(name.casefold()[len(start) :], name)
    return inside


def _pattern(entry: Pass) -> str:
    return re.escape(entry.name.casefold()).replace(r"\*", "[^.]+")


def _find(inside: Mapping[str, str], entry: Pass) -> tuple[str, ...] | None:
    """Full names of the channels of a pass, or None where one of them is missing."""
    stem = _pattern(entry)
    for components in entry.components:
        first, *others = (component.casefold() for component in components)
        for name in inside:
            if re.fullmatch(stem + re.escape(first), name):
                full = [inside.get(name.removesuffix(first) + component) for component in (first, *others)]
                present = tuple(channel for channel in full if channel is not None)
                if len(present) == len(components):
                    return present
    return None


def _beside(names: Sequence[str], color: str, role: str) -> tuple[str, ...] | None:
    """Look for a role in the pass of a colour channel, then in the layers around it, the innermost first."""
    scope = color
    while scope:
        scope = scope.rpartition(".")[0]
        inside = _inside(names, scope)
        for entry in _entries(role):
            if found := _find(inside, entry):
                return found
    return None


def _color(names: Sequence[str], layer: str | None, file: str) -> tuple[str, ...]:
    known = layers(names) or _lone_pass(names)
    if layer is None and not known:
        passes = ", ".join(entry.name + entry.components[0][0] for entry in _entries("color"))
        raise ChannelError(
            f"{file}: expected a colour pass ({passes}), but got {listed(names)}; "
            "name the layer that holds the colour as FILE.exr::LAYER"
        )
    wanted = [layer, *(name for name in known if name.startswith(f"{layer}."))] if layer is not None else known
    for name in wanted[:2]:
        inside = _inside(names, name)
        for entry in _entries("color"):
            if found := _find(inside, entry):
                return found
    there = f"the layers {listed(known)}" if any(known) else f"the channels {listed(names)}"
    raise ChannelError(f"{file}: expected a layer with a colour pass, but got '{layer}'; there are {there}")


def _lone_pass(names: Sequence[str]) -> list[str]:
    """The one pass with R, G, B that no other role claims; none where it is not the only one."""
    bare = next(_entries("color"))
    rgb = [name[:-2] for name in names if name.casefold().endswith(".r")]
    claims = [_pattern(entry) for entry in TABLE if entry.role != "color" and _RGB in entry.components]
    free = [
        name
        for name in rgb
        if _find(_inside(names, name), bare)
        and not any(re.fullmatch(claim, name.casefold().rpartition(".")[2]) for claim in claims)
    ]
    return free if len(free) == 1 else []


def _named(names: Sequence[str], role: str, wanted: str, layer: str | None, file: str) -> tuple[str, ...]:
    """Channels that the user names for a role, with or without the layer in front."""
    counts = motion.COUNTS if role == MOTION.name else (ROLES[role],)
    components = motion.alternatives(wanted) if role == MOTION.name else _SCALAR if counts == (1,) else (_RGB, _XYZ)
    single = [name.strip().casefold() for name in wanted.split(",")]
    for scope in (layer or "", ""):
        inside = _inside(names, scope)
        exact = tuple(inside[name] for name in single if name in inside)
        if len(exact) == len(single) and len(single) in counts:
            return exact
        if found := _find(inside, Pass(role, wanted, components, "")):
            return found
    expected = "one channel" if counts == (1,) else f"{' or '.join(map(str, counts))} channels"
    raise ChannelError(f"{file}: expected {expected} named '{wanted}' for {role}, but got {listed(names)}")


def listed(names: Sequence[str]) -> str:
    """Names for a message, the first dozen of them."""
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    return (", ".join(name for name in names[:12] if name) or "no channels") + more
