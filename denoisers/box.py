"""The mean of a 15×15 window, features unused: the severe case of the papers, blur and no noise."""

import torch
from torch.nn.functional import avg_pool2d

from denoisers.mirror import mirrored

__all__ = ["Box"]

WINDOW = 15


class Box:
    """Mean over 15×15 pixels, the border mirrored with the edge pixel repeated."""

    name = "box"
    multiple = 1
    features: frozenset[str] = frozenset()

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        """Return the window means of the colour (H, W, 3); works on images smaller than the window."""
        radius = WINDOW // 2
        padded = mirrored(color, top=radius, bottom=radius, left=radius, right=radius)
        columns = avg_pool2d(padded.permute(2, 0, 1), (WINDOW, 1), stride=1)
        return avg_pool2d(columns, (1, WINDOW), stride=1).permute(1, 2, 0)
