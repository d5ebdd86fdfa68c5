"""A frame's halves with the samples of its neighbours, and images of neighbours averaged, both along their motion.

Half a is made from halves a and half b from halves b alone, so that each stays the other's witness. What moved
otherwise than its surface (a mirror's picture, a shadow, a light that changed) is wrong here in ways that no weight can
see; the guard, which judges the result against the frame's own denoised image, takes it only where it is true.
"""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from selfcorrect.frame import Frame
from selfcorrect.history.motion import Motion, features, fetched, warped
from selfcorrect.image.exposure import scale_to_one

__all__ = ["averaged", "excess_of", "gathered"]

# What a fetched pixel may differ in: the best of a few on two frames of one shot; `scripts/bench/shot.py` measures what
# comes of them.
_WIDTHS = {"albedo": 0.2, "normal": 0.5}
_RADIANCE = 0.6  # of the denoised radiance's size, where noisy halves are gathered
_CLEANER = 0.3  # the same for the denoised images themselves, which differ less where they show the same
_DARKEST = 0.01  # squared radiance of a mean near 1; the dark does not get narrower


def gathered(
    frame: Frame, neighbours: Mapping[int, tuple[Frame, Motion]], half: int
) -> tuple[Tensor, dict[int, float]]:
    """One noisy half with the samples of its neighbours, (H, W, 3).

    A fetched pixel weighs ``exp(−‖Δρ‖²/σ_ρ² − ‖Δn‖²/σ_n² − ‖Δz‖²/((ε + ‖z‖²) σ_z²))``, this frame's own pixel 1.

    Args:
        frame: with its denoised halves.
        neighbours: by any number, others and the motion to them.
        half: 0 or 1.

    Returns:
        The half; and by the neighbour's number, the weight of its pixels on average.
    """
    z = frame.candidates[0].halves[half]
    color, total, found = frame.color[half].clone(), torch.ones_like(z[..., :1]), {}
    for number, (other, motion) in neighbours.items():
        theirs = fetched(other.candidates[0].halves[half], motion.offset)
        weight = _weight(frame, z, other, theirs, motion, _RADIANCE, fetched)
        color += weight * fetched(other.color[half], motion.offset)
        total += weight
        found[number] = float(weight.mean())
    return color / total, found


def averaged(
    frame: Frame, image: Tensor, neighbours: Mapping[int, tuple[Frame, Motion, Tensor]]
) -> tuple[Tensor, dict[int, float]]:
    """A denoised image, (H, W, 3), averaged with its neighbours' along their motion; weights as in :func:`gathered`.

    Args:
        frame: whose image it is; its G-buffers are compared with the neighbours'.
        image: of one half, or of both.
        neighbours: by any number, others, the motion to them, and their image of the same half.

    Returns:
        The image; and by the neighbour's number, the weight of its pixels on average.
    """
    sum_, total, found = image.clone(), torch.ones_like(image[..., :1]), {}
    for number, (other, motion, their_image) in neighbours.items():
        theirs = warped(their_image, motion.offset)
        weight = _weight(frame, image, other, theirs, motion, _CLEANER, warped)
        sum_ += weight * theirs
        total += weight
        found[number] = float(weight.mean())
    return (sum_ / total).clamp(min=0), found


def excess_of(neighbours: Mapping[int, tuple[Frame, Motion]]) -> Tensor:
    """How far their noisy halves lie above their denoised ones where they show a pixel's surface, (H, W, halves).

    By the mean of the channels, and above the darker of the denoised halves, which a path of great energy has not
    reached; so lights that change do not count. 0 where no motion is believed.
    """
    brought = []
    for other, motion in neighbours.values():
        a, b = (half.mean(-1, keepdim=True) for half in other.candidates[0].halves)
        usual = torch.minimum(a, b)
        for half in other.color:
            excess = half.mean(-1, keepdim=True) - usual
            brought.append(fetched(excess, motion.offset) * motion.known[..., None])
    return torch.cat(brought, -1)


def _weight(
    frame: Frame,
    z: Tensor,
    other: Frame,
    theirs: Tensor,
    motion: Motion,
    width: float,
    brought: Callable[[Tensor, Tensor], Tensor],
) -> Tensor:
    """Of each pixel of another frame, (H, W, 1): ``theirs`` is its z, brought here, and σ_z is ``width``."""
    darkest = _DARKEST / scale_to_one((z, z)) ** 2
    allowed = width**2 * (darkest + z.square().sum(-1))
    exponent = (theirs - z).square().sum(-1) / allowed.clamp(min=torch.finfo(torch.float32).tiny)
    own, others = features(frame), features(other)
    for name, bandwidth in _WIDTHS.items():
        if name in own and name in others:
            exponent += (brought(others[name], motion.offset) - own[name]).square().sum(-1) / bandwidth**2
    return (torch.exp(-exponent) * motion.known)[..., None]
