"""Which AOVs of a frame's files are corrected, together with which others: found by name, proven by their pixels."""

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcorrect.errors import ChannelError
from selfcorrect.exr.channels import listed
from selfcorrect.exr.decompositions import (
    Aov,
    Decomposition,
    beside,
    candidates,
    closing_error,
    fitted,
    radiance,
    tolerance,
)
from selfcorrect.exr.file import ExrFile, Pixels
from selfcorrect.exr.passes import mean_of

__all__ = ["ALPHA", "Group", "Halves", "Plan", "plan", "planes_of", "written_color"]

ALPHA = "alpha"
"""The name that stands for the alpha of the picture."""

_NEGATIVE = 1e-3  # of the picture's light: a remainder that lacks more shows that the AOVs are no part of the picture


@dataclass(frozen=True)
class Group:
    """AOVs that are corrected together.

    Attributes:
        name: what the log calls it.
        aovs: them.
        wanted: names of those that are written.
        sums: they sum to the picture, alone or with what they leave of it; else each is corrected on its own.
        remainder: they leave a part of the picture.
        closing: by half, how far the noisy sum is from the noisy picture; empty where it is not the sum.
    """

    name: str
    aovs: tuple[Aov, ...]
    wanted: frozenset[str]
    sums: bool = True
    remainder: bool = False
    closing: tuple[float, ...] = ()


@dataclass(frozen=True)
class Plan:
    """What is corrected beside the picture.

    Attributes:
        groups: of AOVs.
        alpha: the channel of alpha that is corrected, or none.
        lines: what the log says of it.
    """

    groups: tuple[Group, ...] = ()
    alpha: str = ""
    lines: tuple[str, ...] = ()

    @property
    def written(self) -> int:
        """How many channels are corrected."""
        return 3 * len({name for group in self.groups for name in group.wanted}) + bool(self.alpha)


class Halves(Mapping[str, tuple[Pixels, Pixels]]):
    """The noisy halves of AOVs by name, (H, W, 3) float32 each, made when they are asked for.

    Args:
        a: half a.
        b: half b.
        aovs: what there is.
        once: channels whose pixels the files give up as soon as they have been asked for.
    """

    def __init__(self, a: ExrFile, b: ExrFile, aovs: Sequence[Aov], once: Container[str] = ()):
        self._files, self._aovs, self._once = (a, b), {aov.name: aov for aov in aovs}, once

    def __getitem__(self, name: str) -> tuple[Pixels, Pixels]:
        aov = self._aovs[name]
        first, second = (radiance(file, aov).astype(np.float32) for file in self._files)
        for channel in aov.channels:
            if channel in self._once:
                for file in self._files:
                    file.give_up(channel)
        return first, second

    def __iter__(self) -> Iterator[str]:
        return iter(self._aovs)

    def __len__(self) -> int:
        return len(self._aovs)


def plan(a: ExrFile, b: ExrFile, color: Sequence[str], wanted: str, alpha: str = "") -> Plan:
    """Find what the user asks for.

    Args:
        a: half a.
        b: half b, whose channels have the same names.
        color: full names of the noisy picture's R, G, B.
        wanted: ``none``; ``auto``, every set that sums to the picture; or names of AOVs, with commas between them,
            among them ``alpha``.
        alpha: full name of the picture's alpha, where there is one.

    Raises:
        ChannelError: an AOV is not there, or in one half only.
    """
    if wanted == "none":
        return Plan()
    names = [name.strip() for name in wanted.split(",") if name.strip()]
    asked_alpha = any(name.casefold() == ALPHA for name in names)
    names = [name for name in names if name.casefold() != ALPHA]
    if asked_alpha and not alpha:
        raise ChannelError(f"{a.path}: expected an alpha channel beside the colour for --aovs {wanted}, but got none")
    sums, lines = _sums(a, b, color)
    if "auto" in [name.casefold() for name in names]:
        if not sums:
            lines.append("AOVs: no set of them sums to the picture; none is corrected: name those to correct")
        return Plan(tuple(sums), alpha if asked_alpha else "", tuple(lines))
    aovs = [_named(a, b, color, name) for name in names]
    groups, lines = _groups_of(a, b, color, aovs, sums)
    return Plan(tuple(groups), alpha if asked_alpha else "", tuple(lines))


def planes_of(a: ExrFile, b: ExrFile, aov: Aov, image: Pixels, *, pass_through: bool = False) -> dict[str, Pixels]:
    """Channels of a corrected AOV, in the types of half a, divided by the colour that is written beside it."""
    image = image.astype(np.float64)
    if aov.color is not None:
        color = written_color(a, b, aov, pass_through=pass_through).astype(np.float64)
        image = np.divide(image, color, out=np.zeros_like(image), where=color > 0)
    result = {}
    for name, values in zip(aov.channels, np.moveaxis(image, -1, 0), strict=True):
        dtype = a.pixels(name).dtype
        result[name] = np.clip(values, None, float(np.finfo(dtype).max)).astype(dtype)
    return result


def written_color(a: ExrFile, b: ExrFile, aov: Aov, *, pass_through: bool = False) -> Pixels:
    """The colour of an AOV that the output will have, (H, W, 3)."""
    assert aov.color is not None
    return np.stack([a.pixels(name) if pass_through else mean_of(a, b, name) for name in aov.color], -1)


def _sums(a: ExrFile, b: ExrFile, color: Sequence[str]) -> tuple[list[Group], list[str]]:
    """Every set that sums to the picture in both halves, and what the log says of those that do and do not."""
    found, lines = list[Group](), list[str]()
    proposed = [one for one in candidates(a.channel_names, color) if _in_both(a, b, one)]
    for one in proposed:
        if any(set(one.aovs) <= set(group.aovs) for group in found):
            continue  # what that set has beyond these is 0
        closing = tuple(closing_error(half, color, one.aovs) for half in (a, b))
        if max(closing) <= max(tolerance(half, color, one.aovs) for half in (a, b)):
            found.append(_group(one, closing))
            lines.append(f"AOVs: {one.name} ({len(one.aovs)}) sum to the picture within {max(closing):.1e}")
        else:
            lines.append(f"AOVs: {one.name} ({len(one.aovs)}) do not sum to the picture: off by {max(closing):.1e}")
    taken = {aov.name for group in found for aov in group.aovs}
    more = fitted(a, color, sorted(taken))
    if more is not None and _in_both(a, b, more):
        closing = tuple(closing_error(half, color, more.aovs) for half in (a, b))
        if max(closing) <= max(tolerance(half, color, more.aovs) for half in (a, b)):
            found.append(_group(more, closing))
            names = ", ".join(aov.name for aov in more.aovs)
            lines.append(f"AOVs: {names} sum to the picture within {max(closing):.1e}")
    return found, lines


def _group(one: Decomposition, closing: tuple[float, ...]) -> Group:
    return Group(one.name, one.aovs, frozenset(aov.name for aov in one.aovs), closing=closing)


def _in_both(a: ExrFile, b: ExrFile, one: Decomposition) -> bool:
    there = set(b.channel_names)
    return all(
        name in there and a.pixels(name).shape == b.pixels(name).shape and a.pixels(name).dtype.kind == "f"
        for aov in one.aovs
        for name in (*aov.channels, *(aov.color or ()))
    )


def _named(a: ExrFile, b: ExrFile, color: Sequence[str], name: str) -> Aov:
    """An AOV that the user names, with or without its layer."""
    aovs = {aov.name.casefold(): aov for aov in beside(a.channel_names, color)}
    layer = color[0].rpartition(".")[0].rpartition(".")[0]
    found = aovs.get(name.casefold().removeprefix(f"{layer}.".casefold() if layer else ""))
    if found is None:
        there = listed([aov.name for aov in aovs.values()])
        raise ChannelError(f"{a.path}: expected an AOV '{name}' with R, G, B beside the colour, but got {there}")
    if not _in_both(a, b, Decomposition("", (found,))):
        raise ChannelError(
            f"{b.path}: expected the AOV '{name}' like {a.path}, but got none of its size; render both halves with "
            "the same AOVs"
        )
    return found


def _groups_of(
    a: ExrFile, b: ExrFile, color: Sequence[str], aovs: Sequence[Aov], sums: Sequence[Group]
) -> tuple[list[Group], list[str]]:
    """Named AOVs: those of a set that sums with all of that; others with what they leave of the picture, or alone."""
    groups, lines, left = list[Group](), list[str](), list(aovs)
    for group in sums:
        own = [aov for aov in left if aov in group.aovs]
        if own:
            groups.append(replace(group, wanted=frozenset(aov.name for aov in own)))
            told = ", ".join(aov.name for aov in own)
            lines.append(f"AOVs: {told}: of {group.name}, which sum to the picture within {max(group.closing):.1e}")
        left = [aov for aov in left if aov not in own]
    if left:
        names = ", ".join(aov.name for aov in left)
        lacking = max(_lacking(half, color, left) for half in (a, b))
        sums_with_rest = lacking <= _NEGATIVE
        name = "named AOVs"
        groups.append(Group(name, tuple(left), frozenset(aov.name for aov in left), sums_with_rest, sums_with_rest))
        if sums_with_rest:
            lines.append(f"AOVs: {names}: no set that sums to the picture; corrected with what they leave of it")
        else:
            lines.append(
                f"AOVs: {names}: no part of the picture, which they exceed by {100 * lacking:.1g} % of its light; "
                "each is corrected on its own"
            )
    return groups, lines


def _lacking(file: ExrFile, color: Sequence[str], aovs: Sequence[Aov]) -> float:
    """How much light AOVs have where the picture has less, as a share of the picture's."""
    picture = np.stack([file.pixels(name).astype(np.float64) for name in color], -1)
    rest = picture - sum(radiance(file, aov) for aov in aovs)
    known = np.isfinite(rest)
    total = float(np.abs(picture[known]).sum())
    return float(np.maximum(-rest[known], 0).sum()) / total if total > 0 else float("inf")
