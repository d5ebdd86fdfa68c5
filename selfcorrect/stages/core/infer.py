"""The trained network on a whole image, tile by tile: memory does not grow with the frame."""

import torch
from torch import Tensor

from selfcorrect.frame import Half
from selfcorrect.image.tiles import Region, tiles
from selfcorrect.kernel.cross_bilateral import Window, cross_bilateral
from selfcorrect.kernel.guides import Guides
from selfcorrect.settings import Settings
from selfcorrect.stages.core.network import Network

__all__ = ["SIDE", "infer", "infer_tile"]

SIDE = 512  # of the tiles, pixels; the network reads 9 more on each side, so that 7 % of the work is done twice


def infer(
    network: Network,
    half: Half,
    settings: Settings,
    *,
    scale: float = 1.0,
    side: int = SIDE,
    rows: slice | None = None,
) -> Tensor:
    """The corrected half, (H, W, 3), of radiance times ``scale``; the same bits whatever the tiles' side.

    Args:
        network: trained.
        half: its buffers, radiance not scaled.
        settings: of the network.
        scale: what radiance is multiplied by.
        side: of the tiles, pixels.
        rows: those wanted, by default all.
    """
    first, beyond = (0, half.color.shape[0]) if rows is None else (rows.start, rows.stop)
    image = half.color.new_empty(beyond - first, half.color.shape[1], 3)
    for top, left, bottom, right in tiles((image.shape[0], image.shape[1]), side):
        region = (first + top, left, first + bottom, right)
        image[top:bottom, left:right] = infer_tile(network, half, settings, region, scale=scale)
    return image


@torch.no_grad()
def infer_tile(
    network: Network,
    half: Half,
    settings: Settings,
    region: Region,
    *,
    scale: float = 1.0,
) -> Tensor:
    """One region (top, left, bottom, right) of what :func:`infer` gives."""
    height, width, _ = half.color.shape
    top, left, bottom, right = region
    reach = settings.layers  # zeros are padded at the image's border alone
    above, before = min(reach, top), min(reach, left)
    below, after = min(reach, height - bottom), min(reach, width - right)
    window = Window.of(settings).whole
    guides = Guides.of_half(half._asdict(), margin=max(window.radius, reach), scale=scale, region=region)
    origin = torch.zeros(1, 2, dtype=torch.int64)
    around = (above + guides.height + below, before + guides.width + after)
    raw = network(
        guides.views(origin - torch.tensor([[above, before]]), around),
        region=(above, before, above + guides.height, before + guides.width),
    )
    g = cross_bilateral(guides, raw, origin, window, threads=torch.get_num_threads())
    return g[0].permute(1, 2, 0)
