"""The AOVs of a frame's files, corrected, as channels to write: what was planned, one set after the other."""

from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from selfcorrect.aovs import AovSum, Denoise, correct_alone, correct_aovs
from selfcorrect.exr.aovs import Group, Halves, Plan, planes_of, written_color
from selfcorrect.exr.file import ExrFile, Pixels
from selfcorrect.frame import Frame

__all__ = ["Channels", "correct_channels"]


class Channels(NamedTuple):
    """Corrected AOVs.

    Attributes:
        planes: full name → (height, width) array in the types of half a.
        lines: what the log says of them.
        facts: by name of a sum, how far it was from the picture in the noisy halves, how large the gap was that was
            divided, and what is left of it, as shares of the picture.
    """

    planes: dict[str, Pixels]
    lines: list[str]
    facts: dict[str, dict[str, float]]


def correct_channels(
    halves: tuple[ExrFile, ExrFile],
    plan: Plan,
    image: Any,
    frame: Frame,
    denoise: Denoise,
    *,
    pass_through: bool = False,
) -> Channels:
    """Correct the AOVs that were planned.

    Args:
        halves: the files of both.
        plan: what to correct (:func:`selfcorrect.exr.aovs.plan`).
        image: the corrected picture, (H, W, 3) linear radiance, NumPy or torch.
        frame: the denoised frame that it was made of.
        denoise: see :func:`selfcorrect.aovs.denoiser_of`.
        pass_through: colours that AOVs were divided by are written as half a has them.

    Raises:
        FrameError: an AOV is of another size than the frame, or hardly finite.
    """
    found, done = Channels({}, [], {}), dict[str, Tensor]()
    target = torch.as_tensor(image).float().cpu()
    for i, group in enumerate(plan.groups):
        later = {aov.name for other in plan.groups[i + 1 :] for aov in other.aovs}
        if group.sums:
            images = _sum(halves, group, target, done, frame, denoise, found, pass_through=pass_through)
        else:
            pairs = Halves(*halves, group.aovs)
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


def _sum(
    halves: tuple[ExrFile, ExrFile],
    group: Group,
    target: Tensor,
    done: dict[str, Tensor],
    frame: Frame,
    denoise: Denoise,
    found: Channels,
    *,
    pass_through: bool,
) -> dict[str, Tensor]:
    """The AOVs of a group that sums, but those that an earlier one has made sum; adds to the lines and facts found."""
    shared = [aov.name for aov in group.aovs if aov.name in done]
    own = [aov for aov in group.aovs if aov.name not in shared]
    rest = target
    for name in shared:
        rest = rest - done[name]
    colors = {
        aov.name: torch.from_numpy(written_color(*halves, aov, pass_through=pass_through))
        for aov in own
        if aov.color is not None
    }
    sums = AovSum(group.name, Halves(*halves, own), group.remainder, colors)
    corrected = correct_aovs(rest.clamp(min=0), frame, sums, denoise)
    found.facts[group.name] = {
        "noisy": max(group.closing, default=0.0),
        "gap": corrected.gap,
        "left": corrected.closing,
    }
    found.lines.append(
        f"AOVs: {group.name}: missed the picture by {100 * corrected.gap:.2g} %, which was divided among them; "
        f"now within {corrected.closing:.1e}"
    )
    return corrected.images


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
