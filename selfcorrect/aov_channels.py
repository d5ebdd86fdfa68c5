"""The AOVs of a frame's files, corrected, as channels to write: what was planned, one set after the other."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.aovs import AovSum, Corrected, Denoise, correct_alone, correct_aovs, correct_sums
from selfcorrect.exr.aovs import Group, Halves, Plan, planes_of, written_color
from selfcorrect.exr.decompositions import Aov
from selfcorrect.exr.file import ExrFile, Pixels
from selfcorrect.frame import Frame

__all__ = ["Channels", "correct_channels"]


class Channels(NamedTuple):
    """Corrected AOVs.

    Attributes:
        planes: full name → (height, width) array in the types of half a.
        lines: what the log says of them.
        facts: by name of a sum, how far it was from the picture in the noisy halves, how large the gap was that was
            divided, and what is left of it, as shares of the picture; and how far the picture moved to their sum.
        picture: what they sum to, (H, W, 3): the corrected picture, where sums were better with what it took of them.
    """

    planes: dict[str, Pixels]
    lines: list[str]
    facts: dict[str, dict[str, float]]
    picture: Tensor


def correct_channels(
    halves: tuple[ExrFile, ExrFile],
    plan: Plan,
    image: Any,
    frame: Frame,
    denoise: Denoise,
    *,
    corrected_halves: tuple[Tensor, Tensor] | None = None,
    pass_through: bool = False,
) -> Channels:
    """Correct the AOVs that were planned.

    Args:
        halves: the files of both; they give up the pixels of AOVs, one after the other.
        plan: what to correct (:func:`selfcorrect.exr.aovs.plan`).
        image: the corrected picture, (H, W, 3) linear radiance, NumPy or torch.
        frame: the denoised frame that it was made of.
        denoise: see :func:`selfcorrect.aovs.denoiser_of`.
        corrected_halves: of the picture, see :func:`selfcorrect.correct_aovs`.
        pass_through: colours that AOVs were divided by are written as half a has them.

    Raises:
        FrameError: an AOV is of another size than the frame, or hardly finite.
    """
    once = _read_once(plan.groups)
    through = _Through(halves, frame, denoise, once, pass_through=pass_through)
    own = _apart(plan.groups)
    first = correct_sums(image, frame, [through.sum_of(g, g.aovs) for g in own], denoise, corrected_halves)
    made = {group.name: corrected for group, corrected in zip(own, first, strict=True)}
    found, done = Channels({}, [], {}, first[0].picture if first else torch.as_tensor(image)), dict[str, Tensor]()
    del first
    for i, group in enumerate(plan.groups):
        later = {aov.name for other in plan.groups[i + 1 :] for aov in other.aovs}
        if group.sums:
            corrected = made.pop(group.name, None) or through.rest(group, found.picture, done)
            found.facts[group.name], lines = _told(group, corrected)
            found.lines.extend(lines)
            images = corrected.images
            del corrected
        else:
            pairs = Halves(*halves, group.aovs, once)
            images = {name: correct_alone(frame, name, pairs[name], denoise) for name in pairs}
        done |= {name: image for name, image in images.items() if name in later}
        for aov in group.aovs:
            image = images.pop(aov.name, None)  # what is written takes its place in memory
            if aov.name in group.wanted and image is not None:
                found.planes.update(planes_of(*halves, aov, image.numpy(), pass_through=pass_through))
                del image
    if plan.alpha:
        found.planes[plan.alpha] = _alpha(halves, plan.alpha, frame, denoise)
    return found


class _Through:
    """What the sums of a frame's files have in common."""

    def __init__(
        self,
        halves: tuple[ExrFile, ExrFile],
        frame: Frame,
        denoise: Denoise,
        once: frozenset[str],
        *,
        pass_through: bool,
    ):
        self._halves, self._frame, self._denoise, self._pass_through = halves, frame, denoise, pass_through
        self._once = once

    def sum_of(self, group: Group, aovs: Sequence[Aov]) -> AovSum:
        """AOVs of a group, with the colours that they will be divided by."""
        colors = {
            aov.name: torch.from_numpy(written_color(*self._halves, aov, pass_through=self._pass_through))
            for aov in aovs
            if aov.color is not None
        }
        return AovSum(group.name, Halves(*self._halves, aovs, self._once), group.remainder, colors)

    def rest(self, group: Group, picture: Tensor, done: dict[str, Tensor]) -> Corrected:
        """The AOVs of a group but those that an earlier one has made sum, which stay."""
        shared = [aov.name for aov in group.aovs if aov.name in done]
        own = [aov for aov in group.aovs if aov.name not in shared]
        left = picture
        for name in shared:
            left = left - done[name]
        return correct_aovs(left.clamp(min=0), self._frame, self.sum_of(group, own), self._denoise)


def _read_once(groups: Sequence[Group]) -> frozenset[str]:
    """Channels that one AOV of one set has to itself: nothing else will read them."""
    aovs = [aov for group in groups for aov in group.aovs]
    counts = Counter(channel for aov in aovs for channel in (*aov.channels, *(aov.color or ())))
    return frozenset(channel for aov in aovs for channel in aov.channels if counts[channel] == 1)


def _apart(groups: Sequence[Group]) -> list[Group]:
    """Groups that sum and share no AOV with an earlier one of them."""
    found, names = list[Group](), set[str]()
    for group in groups:
        own = {aov.name for aov in group.aovs}
        if group.sums and not own & names:
            found.append(group)
        if group.sums:
            names |= own
    return found


def _told(group: Group, corrected: Corrected) -> tuple[dict[str, float], list[str]]:
    """The facts and the log's lines of a sum."""
    facts = {
        "noisy": max(group.closing, default=0.0),
        "gap": corrected.gap,
        "left": corrected.closing,
        "moved": corrected.moved,
    }
    lines = []
    if corrected.moved > 0:
        lines.append(
            f"AOVs: {group.name}: the picture takes {100 * corrected.moved:.2g} % of what their sum has otherwise, "
            "where the halves are certain of it"
        )
    lines.append(
        f"AOVs: {group.name}: missed the picture by {100 * corrected.gap:.2g} %, which was divided among them; "
        f"now within {corrected.closing:.1e}"
    )
    return facts, lines


def _alpha(halves: tuple[ExrFile, ExrFile], name: str, frame: Frame, denoise: Denoise) -> Pixels:
    """Alpha, denoised like a grey AOV, in [0, 1]; where both halves are 1 for a pixel and its neighbours it stays 1,
    as it stays 0 where they are 0.
    """
    planes = [file.pixels(name).astype(np.float32) for file in halves]
    first, second = (np.repeat(plane[:, :, None], 3, -1) for plane in planes)
    image = correct_alone(frame, "alpha", (first, second), denoise).mean(-1).clamp(0, 1)
    open_ = torch.from_numpy(np.minimum(*planes) < 1).float()
    solid = F.max_pool2d(open_[None], 3, 1, 1)[0] == 0
    alpha: Pixels = torch.where(solid, 1.0, image).numpy().astype(halves[0].pixels(name).dtype)
    return alpha
