"""How much a half that a stage made knows of the other half's noise."""

import torch

from selfcorrect.frame import Half
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Stage, Work


def share_of_witness(stage: Stage, *, heavy: bool, side: int = 128) -> float:
    """Covariance of half a with half b's noise over its variance, and the other way round, of radiance near 1.

    Args:
        stage: under test.
        heavy: log-normal noise instead of Gaussian.
        side: of the image.
    """
    generator = torch.Generator().manual_seed(0)
    size, shares = (side, side, 3), []
    for _ in range(4):
        errors = [0.1 * torch.randn(size, generator=generator) for _ in "ab"]
        if heavy:
            errors = [0.02 * (torch.exp(15 * e) - 3.08) for e in errors]  # of mean 0
        halves = [Half(1 + e, torch.full(size, 0.95)) for e in errors]
        images = stage.run(StageImages((halves[0], halves[1]), torch.full(size, 0.95)), Work()).state.images
        for i in (0, 1):
            shares.append(float(((images[i] - 1) * errors[1 - i]).mean() / errors[1 - i].var()))
    return sum(shares) / len(shares)
