"""The trained network on a whole image, tile by tile: memory does not grow with the frame."""

from collections.abc import Iterator

import torch
from torch import Tensor

from selfcorrect.frame import Half
from selfcorrect.kernel import Guides, cross_bilateral
from selfcorrect.network import Network
from selfcorrect.settings import Settings

__all__ = ["TILE", "Region", "infer", "infer_tile", "tiles"]

TILE = 512  # pixels; the network reads 9 more on each side, so that 7 % of the work is done twice

Region = tuple[int, int, int, int]


def tiles(size: tuple[int, int], side: int = TILE) -> Iterator[Region]:
    """Regions (top, left, bottom, right) that cover an image of this size once.

    >>> list(tiles((3, 5), 4))
    [(0, 0, 3, 4), (0, 4, 3, 5)]
    """
    for top in range(0, size[0], side):
        for left in range(0, size[1], side):
            yield top, left, min(top + side, size[0]), min(left + side, size[1])


def infer(
    network: Network,
    half: Half,
    settings: Settings,
    *,
    scale: float = 1.0,
    denoised: Tensor | None = None,
    side: int = TILE,
    rows: slice | None = None,
) -> Tensor:
    """The corrected half, (H, W, 3), of radiance times ``scale``; the same bits whatever the tiles' side.

    Args:
        network: trained.
        half: its buffers, radiance not scaled.
        settings: of the network.
        scale: what radiance is multiplied by.
        denoised: another denoised image than the half's own.
        side: of the tiles, pixels.
        rows: those wanted, by default all.
    """
    first, beyond = (0, half.color.shape[0]) if rows is None else (rows.start, rows.stop)
    image = half.color.new_empty(beyond - first, half.color.shape[1], 3)
    for top, left, bottom, right in tiles((image.shape[0], image.shape[1]), side):
        region = (first + top, left, first + bottom, right)
        image[top:bottom, left:right] = infer_tile(network, half, settings, region, scale=scale, denoised=denoised)
    return image


@torch.no_grad()
def infer_tile(
    network: Network,
    half: Half,
    settings: Settings,
    region: Region,
    *,
    scale: float = 1.0,
    denoised: Tensor | None = None,
) -> Tensor:
    """One region (top, left, bottom, right) of what :func:`infer` gives."""
    shown = half.denoised if denoised is None else denoised
    assert shown is not None  # correct() has checked; tells the type checker
    height, width, _ = half.color.shape
    top, left, bottom, right = region
    reach = settings.layers  # zeros are padded at the image's border alone
    above, before = min(reach, top), min(reach, left)
    below, after = min(reach, height - bottom), min(reach, width - right)
    guides = Guides.of_half(
        half.color,
        shown,
        margin=max(settings.window // 2, reach),
        albedo=half.albedo,
        normal=half.normal,
        visibility=half.visibility,
        scale=scale,
        region=region,
    )
    origin = torch.zeros(1, 2, dtype=torch.int64)
    around = (above + guides.height + below, before + guides.width + after)
    raw = network(
        guides.views(origin - torch.tensor([[above, before]]), around),
        region=(above, before, above + guides.height, before + guides.width),
    )
    g = cross_bilateral(
        guides,
        raw,
        origin,
        window=settings.window,
        combination=settings.combination,
        threads=torch.get_num_threads(),
    )
    return g[0].permute(1, 2, 0)
