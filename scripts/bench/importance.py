"""Training patches drawn where the halves say that the denoiser errs, instead of anywhere.

    .venv/bin/python scripts/bench/importance.py ../shared/frames [--frames …] [--spp 64] [--share 0.5] [--seeds 1]
        [--threads 1]

The bias of the denoised halves is what can be gained, and (y^a − z^a)·(y^b − z^b), weighed as in Eq. 8, has its square
as mean: the halves' noise is independent. A patch is drawn with a probability that is by --share the root of that mean
over the patch, and else the same everywhere; a patch that is drawn k times as often counts a k-th, so that the loss is
that of patches drawn anywhere. Prints the error of the corrected image over that of the denoised one for each frame,
with patches drawn anywhere by the same code, drawn thus, and how unequally.
"""

import argparse
import math
from pathlib import Path

import torch
import torch.nn.functional as F
from stopping import WARM_UP, Given, corrected, prepared, untrained
from torch import Tensor

from selfcorrect import Settings, metrics
from selfcorrect.kernel.guides import Guides
from selfcorrect.stages.core.loss import dual_buffer_loss, relative_weight, witnesses
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import steps_count
from selfcorrect.stages.core.stage import Core
from selfcorrect.stages.core.train import Adam
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Outcome, Work

EVERY = 8  # pixels from one place where a patch may begin to the next


class Places:
    """Where patches may begin, how probable each is, and what a patch there counts for.

    Args:
        guides: of both halves.
        settings: of the patches.
        share: of the probability that goes where the denoiser errs, 0 … 1.
    """

    def __init__(self, guides: tuple[Guides, Guides], settings: Settings, share: float):
        reach, side = settings.patch // 4, settings.patch
        rests = [half.radiance - half.denoised for half in guides]
        weight = sum(relative_weight(half.denoised, settings.loss_epsilon) for half in guides) / 2
        margin = guides[0].margin - reach  # planes begin that far before the first place
        product = (weight * (rests[0] * rests[1]).mean(0))[margin:, margin:]
        height, width = guides[0].height + 2 * reach, guides[0].width + 2 * reach
        bias = F.avg_pool2d(product[None, None, :height, :width], side, EVERY)[0, 0].clamp(min=0).sqrt()
        rows, columns = (EVERY * torch.arange(count) - reach for count in bias.shape)
        self.corners = torch.cartesian_prod(rows, columns)
        even = torch.full([len(self.corners)], 1 / len(self.corners))
        self.probability = (1 - share) * even + share * bias.flatten() / bias.sum()
        self.weight = even / self.probability

    def draw(self, count: int, generator: torch.Generator) -> Tensor:
        """Indices of so many."""
        return torch.multinomial(self.probability, count, replacement=True, generator=generator)


class Drawn(Core):
    """The core, its patches drawn from :class:`Places`."""

    def __init__(self, settings: Settings, share: float):
        super().__init__(settings)
        self._share = share
        self.largest = 0.0

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Train, then infer."""
        network, guides, generator = untrained(state, self.settings)
        self._train(network, guides, generator)
        return Given(self.settings, network).run(state, work)

    def _train(self, network: Network, guides: tuple[Guides, Guides], generator: torch.Generator) -> None:
        settings, patch = self.settings, (self.settings.patch, self.settings.patch)
        places, judges = Places(guides, settings, self._share), witnesses(guides, settings)
        self.largest = float(1 / places.weight.min())
        optimiser = Adam(network.parameters(), settings.adam_epsilon, settings.gradient_limit or math.inf)
        steps = steps_count((guides[0].height, guides[0].width), settings)
        for step in range(steps):
            drawn = places.draw(settings.batch, generator)
            loss = torch.zeros(())
            for index in drawn.split(1):  # one at a time, as each has a weight of its own
                corners = places.corners[index]
                raw = network([view for half in guides for view in half.views(corners, patch)])
                own = dual_buffer_loss(raw, corners, guides, judges, settings)
                loss = loss + own * float(places.weight[index]) / settings.batch
            torch.autograd.backward(loss)
            warm = min(1.0, (step + 1) / WARM_UP)
            rate = settings.learning_rate * warm * (1 + math.cos(math.pi * step / steps)) / 2
            optimiser.step(rate, loss.detach())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[64])
    parser.add_argument("--share", type=float, default=0.5)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    logs = []
    print("| frame | spp | seed | anywhere | where the denoiser errs | most often, times |\n|---|---|---|---|---|---|")
    for name in names:
        for spp in options.spp:
            frame, references = prepared(options, name, spp)
            denoised = metrics.relmse(frame.denoised_full, *references)
            for seed in range(options.seeds):
                settings = Settings.preset("balanced", seed=seed)
                stages = [Drawn(settings, share) for share in (0.0, options.share)]
                errors = [metrics.relmse(corrected(frame, settings, s), *references) / denoised for s in stages]
                logs.append(math.log(errors[1] / errors[0]))
                cells = [f"{error:.4f}" for error in errors] + [f"{stages[1].largest:.1f}"]
                print(f"| {name} | {spp} | {seed} | {' | '.join(cells)} |", flush=True)
    print(f"geometric mean of the ratios {math.exp(sum(logs) / len(logs)):.4f}, worst {math.exp(max(logs)):.4f}")


if __name__ == "__main__":
    main()
