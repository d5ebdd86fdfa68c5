"""A frame's halves with the samples of its neighbours, fetched along their motion: the candidate ``history``.

Half a is gathered from halves a and half b from halves b alone, so that each stays the other's witness. What moved
otherwise than its surface (a mirror's picture, a shadow, a light that changed) is wrong here in ways that no weight can
see; the guard, which judges the result against the frame's own denoised image, takes it only where it is true.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from selfcorrect.errors import FrameError
from selfcorrect.frame import Candidate, Frame, mean, prefiltered
from selfcorrect.history.motion import Motion, between, fetched, picture

__all__ = ["History", "gathered", "with_history"]

# Bandwidths of what a fetched pixel may differ in: the best of ten on two frames of one shot, not cross-validated.
_ALBEDO = 0.2
_NORMAL = 0.5
_RADIANCE = 0.6  # of the denoised radiance's size
_DARKEST = 0.01  # squared radiance of a mean near 1; the dark does not get narrower


class History(NamedTuple):
    """What was found in the neighbours.

    Attributes:
        neighbours: their distances in frames, negative before, that were used.
        found: by distance, the share of the frame's pixels that found their surface there.
        samples: how many frames' samples a pixel has on average, 1 without neighbours.
    """

    neighbours: tuple[int, ...]
    found: dict[int, float]
    samples: float


def with_history(frame: Frame, neighbours: Mapping[int, Frame], denoiser: Callable[..., Any]) -> tuple[Frame, History]:
    """The frame with one candidate more: its halves gathered from the neighbours too, and denoised.

    Args:
        frame: with its denoised halves.
        neighbours: by distance in frames (−1 is the one before), with their denoised halves; of the same size.
        denoiser: as for :meth:`selfcorrect.Frame.denoise`; not one that needs both halves at once.

    Raises:
        FrameError: a neighbour has another size, or shares its noise with this frame.
        MissingPackageError: there is no optical flow.
    """
    for distance, other in neighbours.items():
        if other.size != frame.size:
            raise FrameError(f"expected a neighbour of size {frame.size} at {distance:+d}, but got {other.size}")
        if any(torch.equal(mine, its) for mine, its in zip(frame.color, other.color, strict=True)):
            raise FrameError(
                f"expected a neighbour at {distance:+d} with noise of its own, but got this frame's: render each frame "
                "with a seed of its own"
            )
    if not neighbours:
        return frame, History((), {}, 1.0)
    here = picture(frame)
    motions = {distance: between(here, picture(other)) for distance, other in sorted(neighbours.items())}
    halves, total = [], torch.zeros(())
    for i in (0, 1):
        half, weight = gathered(frame, neighbours, motions, i)
        halves.append(half)
        total = total + weight.mean() / 2
    full = mean((halves[0], halves[1]))
    features = [(half.albedo, half.normal) for half in frame.halves]
    both = [None if a is None or b is None else mean((a, b)) for a, b in zip(*features, strict=True)]
    images = [
        torch.as_tensor(denoiser(color, **prefiltered(denoiser, *given))).clamp(min=0)
        for color, given in ((full, both), (halves[0], features[0]), (halves[1], features[1]))
    ]
    found = {distance: float(motion.known.float().mean()) for distance, motion in motions.items()}
    candidate = Candidate("history", (images[1], images[2]), images[0])
    return frame.with_candidate(candidate), History(tuple(sorted(neighbours)), found, float(total))


def gathered(
    frame: Frame, neighbours: Mapping[int, Frame], motions: Mapping[int, Motion], half: int
) -> tuple[Tensor, Tensor]:
    """One half with the samples of its neighbours, (H, W, 3), and the weight of all together, (H, W, 1) ≥ 1.

    A fetched pixel weighs ``exp(−‖Δρ‖²/σ_ρ² − ‖Δn‖²/σ_n² − ‖Δz‖²/((ε + ‖z‖²) σ_z²))``, this frame's own pixel 1.
    """
    color = frame.color[half].clone()
    total = torch.ones_like(color[..., :1])
    z = frame.candidates[0].halves[half]
    level = z.square().sum(-1)
    scale = _RADIANCE**2 * (_DARKEST * float(level.mean()) + level).clamp(min=torch.finfo(torch.float32).tiny)
    own = {name: mean(pair) for name in ("albedo", "normal") if (pair := getattr(frame, name)) is not None}
    for distance, other in neighbours.items():
        offset, known = motions[distance]
        exponent = (fetched(other.candidates[0].halves[half], offset)[0] - z).square().sum(-1) / scale
        for name, width in (("albedo", _ALBEDO), ("normal", _NORMAL)):
            theirs = getattr(other, name)
            if name in own and theirs is not None:
                exponent = exponent + (fetched(mean(theirs), offset)[0] - own[name]).square().sum(-1) / width**2
        samples, inside = fetched(other.color[half], offset)
        weight = (torch.exp(-exponent) * (known & inside))[..., None]
        color += weight * samples
        total += weight
    return color / total, total
