"""Training that stops: what each number of steps is worth, and what tiles that training has not seen say of it.

    .venv/bin/python scripts/bench/stopping.py ../shared/frames [--frames …] [--spp 64] [--steps 400] [--look 50]
        [--held 4] [--seeds 1] [--threads 1]

The preset's network is trained at a constant rate, and what a look sees is the mean of the weights over about the last
quarter of the steps (:class:`Average`), as that can be stopped anywhere; the preset's own schedule has to know its end
beforehand. One block of 16 pixels in --held² is held out: no pixel there, nor its mirror image beyond the border, is
a target. Every --look steps Eq. 8 of the blocks is compared, block by block, with that of the untrained start.

Prints for each frame and look the error of the corrected image over that of the denoised one, and the gain on the
blocks, since the start and since the look before, with standard errors, in per cent of Eq. 8 of the start (most of
which is noise); beside it the preset as it is. Then the steps and the error over that of all steps and over that of
the preset: of as many steps for every frame; of each of RULES, which stop after so many looks that each gained less
than a share of all so far; and for each scene of the rule that is best for the others, fewest steps at no more than
1 % of error over all steps.
"""

import argparse
import copy
import math
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from quality import load
from torch import Tensor

import denoisers
from selfcorrect import Frame, Settings, correct, metrics
from selfcorrect.candidates import with_candidates
from selfcorrect.kernel.guides import Guides, mirror
from selfcorrect.stages.core.loss import Witness, dual_buffer_loss, witnesses
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.patches import batches, overhang, steps_count
from selfcorrect.stages.core.stage import Core
from selfcorrect.stages.core.train import Adam
from selfcorrect.stages.images import StageImages
from selfcorrect.stages.stage import Outcome, Work

BLOCK = 16  # side of what is held out, pixels: that of the guard's tiles
WARM_UP = 20  # steps, as in training
AVERAGED = 3.0  # about one over the share of the steps so far that the mean of the weights is of, less one
OUTERMOST = 0.02  # share of the blocks at either end that are pulled in: fireflies
RULES = [(worth, looks) for looks in (1, 2, 3) for worth in (0.0, 0.02, 0.05, 0.1, 0.2)]
LOST = 1.01  # of error, at most


class Look(NamedTuple):
    """What was seen after so many steps: Eq. 8 of each block, and the network."""

    steps: int
    network: Network
    losses: Tensor


class Gain(NamedTuple):
    """On the blocks, in the mean, and its standard error."""

    mean: float
    error: float


class Measured(NamedTuple):
    """A frame: relMSE over the denoised image's at each look and of the preset, and Eq. 8 of the blocks at each."""

    scene: str
    looks: list[int]
    ratios: list[float]
    losses: list[Tensor]
    preset: float


class HeldOut:
    """Blocks that are no target of training, spread over the frame, one in ``every``² of all.

    Args:
        guides: of both halves.
        settings: of the network and the loss.
        every: how many blocks further down and to the right the next one lies.
    """

    def __init__(self, guides: tuple[Guides, Guides], settings: Settings, every: int):
        self._guides, self._settings = guides, settings
        self._judges = witnesses(guides, settings)
        height, width = (size // BLOCK for size in (guides[0].height, guides[0].width))
        blocks = [
            (i, j)
            for i in range(every // 2, height, every)
            for j in range((every // 2 + 2 * (i // every)) % every, width, every)
        ]
        self.corners = BLOCK * torch.tensor(blocks)

    def targets(self) -> tuple[Witness, Witness]:
        """The witnesses, without weight on the blocks and their mirror images beyond the border."""
        half = self._guides[0]
        seen = torch.ones(half.height, half.width)
        for y, x in self.corners.tolist():
            seen[y : y + BLOCK, x : x + BLOCK] = 0
        rows, columns = (mirror(-half.margin, size + half.margin, size) for size in seen.shape)
        weights = [judge.weight.clone() for judge in self._judges]
        for weight in weights:
            weight[: len(rows), : len(columns)] *= seen[rows][:, columns]
        a, b = (judge._replace(weight=weight) for judge, weight in zip(self._judges, weights, strict=True))
        return a, b

    @torch.no_grad()
    def losses(self, network: Network) -> Tensor:
        """Eq. 8 of each block, (N,) float64."""
        reach = self._settings.layers
        around = (BLOCK + 2 * reach, BLOCK + 2 * reach)
        found = []
        for corner in self.corners.split(1):
            views = [view for half in self._guides for view in half.views(corner - reach, around)]
            raw = network(views, region=(reach, reach, reach + BLOCK, reach + BLOCK))
            found.append(dual_buffer_loss(raw, corner, self._guides, self._judges, self._settings).double())
        return torch.stack(found)


class Average:
    """The mean of a network's weights over its last steps, which needs not to know how many there will be.

    Polynomial decay (Shamir and Zhang 2013, Stochastic Gradient Descent for Non-smooth Optimization, Sec. 4): after t
    steps the new weights count for (η + 1) / (t + η).
    """

    def __init__(self, network: Network):
        self.network = copy.deepcopy(network)
        self._steps = 0

    @torch.no_grad()
    def add(self, network: Network) -> None:
        """The weights after one more step."""
        self._steps += 1
        share = (AVERAGED + 1) / (self._steps + AVERAGED)
        for mean, weights in zip(self.network.parameters(), network.parameters(), strict=True):
            mean.lerp_(weights, share)


def untrained(state: StageImages, settings: Settings) -> tuple[Network, tuple[Guides, Guides], torch.Generator]:
    """What training begins with: the network, the guides of both halves, whole, and the seeded generator."""
    generator = torch.Generator().manual_seed(settings.seed)
    size = (state.full.shape[0], state.full.shape[1])
    margin = settings.window // 2 + overhang(size, settings)
    a, b = (Guides.of_half(half._asdict(), margin=margin, scale=state.scale) for half in state.halves)
    return Network.for_guides(a, settings, generator), (a, b), generator


class Watched(Core):
    """The core, looked at now and then while it trains; what it gives is the last look's.

    Attributes:
        looks: the first is at the untrained start.
        seconds: of CPU time for training and for looking at it.
    """

    def __init__(self, settings: Settings, look: int, held: int):
        super().__init__(settings)
        self._look, self._held = look, held
        self.looks: list[Look] = []
        self.seconds = {"train": 0.0, "look": 0.0}

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Train, then infer."""
        self._train(*untrained(state, self.settings))
        return Outcome(self._after(state, self.looks[-1].network, work.keep))

    def _train(self, network: Network, guides: tuple[Guides, Guides], generator: torch.Generator) -> None:
        settings, patch = self.settings, (self.settings.patch, self.settings.patch)
        held, average = HeldOut(guides, settings, self._held), Average(network)
        judges = held.targets()
        optimiser = Adam(network.parameters(), settings.adam_epsilon, settings.gradient_limit or math.inf)
        steps = steps_count((guides[0].height, guides[0].width), settings)
        for step, corners in enumerate(batches(guides[0], settings, generator)):
            if step % self._look == 0 or step == steps:
                began = time.process_time()
                kept = copy.deepcopy(average.network)
                self.looks.append(Look(step, kept, held.losses(kept)))
                self.seconds["look"] += time.process_time() - began
            if step == steps:
                return
            began = time.process_time()
            raw = network([view for half in guides for view in half.views(corners, patch)])
            loss = dual_buffer_loss(raw, corners, guides, judges, settings)
            torch.autograd.backward(loss)
            optimiser.step(settings.learning_rate * min(1.0, (step + 1) / WARM_UP), loss.detach())
            average.add(network)
            self.seconds["train"] += time.process_time() - began


class Given(Core):
    """The core without training: a network as it is."""

    def __init__(self, settings: Settings, network: Network):
        super().__init__(settings)
        self._network = network

    def run(self, state: StageImages, work: Work) -> Outcome:
        """Infer."""
        return Outcome(self._after(state, self._network, work.keep))


def gain(before: Tensor, after: Tensor) -> Gain:
    """Block by block, the outermost pulled in to the next ones."""
    each = (before - after).sort().values
    cut = max(1, int(OUTERMOST * len(each))) if len(each) > 2 else 0
    each = each.clamp(float(each[cut]), float(each[-1 - cut]))
    return Gain(float(each.mean()), float(each.std()) / math.sqrt(len(each)))


def stopped(losses: Sequence[Tensor], worth: float, looks: int) -> int:
    """The look at which training ends: so many one after another gained less than this share of all gained so far."""
    low = 0
    for k in range(1, len(losses)):
        enough = gain(losses[k - 1], losses[k]).mean >= worth * abs(gain(losses[0], losses[k]).mean)
        low = 0 if enough else low + 1
        if low == looks:
            return k
    return len(losses) - 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", nargs="*", help="names; by default all in the folder")
    parser.add_argument("--spp", type=int, nargs="*", default=[64])
    parser.add_argument("--steps", type=int, default=Settings.preset("balanced").steps)
    parser.add_argument("--look", type=int, default=50, help="steps from one look to the next (default: %(default)s)")
    parser.add_argument("--held", type=int, default=4, help="one block in so many squared (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    names = options.frames or sorted({p.name.split("_")[0] for p in options.folder.glob("*_ref_A.exr")})
    rows = [row for name in names for spp in options.spp for row in measured(options, name, spp)]
    summary(rows)


def measured(options: argparse.Namespace, name: str, spp: int) -> Iterable[Measured]:
    """One frame with each seed; printed as it is measured."""
    frame, references = prepared(options, name, spp)
    denoised = metrics.relmse(frame.denoised_full, *references)

    def ratio(settings: Settings, stage: Core) -> float:
        return metrics.relmse(corrected(frame, settings, stage), *references) / denoised

    for seed in range(options.seeds):
        settings = Settings.preset("balanced", seed=seed)
        watched = Watched(Settings.preset("balanced", seed=seed, steps=options.steps), options.look, options.held)
        ratio(settings, watched)
        ratios = [ratio(settings, Given(settings, look.network)) for look in watched.looks]
        losses = [look.losses for look in watched.looks]
        found = Measured(name, [look.steps for look in watched.looks], ratios, losses, ratio(settings, Core(settings)))
        told(found, spp, seed, watched.seconds)
        yield found


def prepared(options: argparse.Namespace, name: str, spp: int) -> tuple[Frame, list[np.ndarray]]:
    """A frame with its denoised images and the candidates that the preset takes, and its references."""
    frame, references = load(options.folder, name, spp)
    frame = frame.denoise(denoisers.create("oidn", threads=options.threads))
    further = {spec: denoisers.create(spec, threads=options.threads) for spec in denoisers.variants("oidn")}
    frame, _ = with_candidates(frame, further, every=False)
    return frame, references


def corrected(frame: Frame, settings: Settings, stage: Core) -> Tensor:
    """The command's image, with this stage for the core."""
    image: Tensor = correct(frame, settings, opened=[stage]).image
    return image


def told(found: Measured, spp: int, seed: int, seconds: dict[str, float]) -> None:
    """Print a frame's table."""
    overhead = seconds["look"] / seconds["train"]
    print(f"\n{found.scene}, {spp} spp, seed {seed}: {len(found.losses[0])} blocks, looks {overhead:.1%} of training;")
    print(f"the preset as it is {found.preset:.4f}")
    print("| steps | error | gain since the start, % | since the last look |\n|---|---|---|---|")
    unit = 100 / float(found.losses[0].mean())
    for k, steps in enumerate(found.looks):
        gains = [gain(found.losses[first], found.losses[k]) for first in (0, k - 1)] if k else []
        cells = [f"{unit * each.mean:.2f} ± {unit * each.error:.2f}" for each in gains] or ["", ""]
        print(f"| {steps} | {found.ratios[k]:.4f} | {' | '.join(cells)} |", flush=True)


def summary(rows: Sequence[Measured]) -> None:
    """Print what stopping saves and costs, and the same with a rule chosen on the other scenes."""
    print("\n| | steps, mean | error over all steps | worst | over the preset | worst |\n|---|---|---|---|---|---|")
    for k, steps in enumerate(rows[0].looks):
        print(f"| {steps} steps | {score(rows, [min(k, len(row.looks) - 1) for row in rows])} |")
    for worth, looks in RULES:
        print(f"| {looks} below {worth:g} of the gain | {score(rows, ends(rows, (worth, looks)))} |")
    fewest = [next(k for k, ratio in enumerate(r.ratios) if ratio <= LOST * r.ratios[-1]) for r in rows]
    print(f"| fewest within {LOST - 1:.0%} of all, by the reference | {score(rows, fewest)} |")
    scenes = list(dict.fromkeys(row.scene for row in rows))
    if len(scenes) > 1:
        by_others(rows, scenes)


def by_others(rows: Sequence[Measured], scenes: Sequence[str]) -> None:
    """Print what each scene gets by the rule that is best for the others, and all together."""
    ordered, chosen = list[Measured](), list[int]()
    for scene in scenes:
        own, others = ([row for row in rows if (row.scene == scene) == same] for same in (True, False))
        good = [rule for rule in RULES if outcome(others, ends(others, rule))[1] <= LOST]
        never = 0.0, len(own[0].looks)
        rule = min(good, key=lambda rule, others=others: outcome(others, ends(others, rule))[0], default=never)
        print(f"| {scene}, by the others {rule[1]} below {rule[0]:g} | {score(own, ends(own, rule))} |")
        ordered += own
        chosen += ends(own, rule)
    print(f"| each by the others' rule | {score(ordered, chosen)} |")


def ends(rows: Sequence[Measured], rule: tuple[float, int]) -> list[int]:
    """The look at which each frame's training ends."""
    return [stopped(row.losses, *rule) for row in rows]


def outcome(rows: Sequence[Measured], looks: Sequence[int]) -> tuple[float, float, float, float, float]:
    """Mean steps; geometric mean and largest of the error over that of all steps, and over that of the preset."""
    steps = float(np.mean([row.looks[k] for row, k in zip(rows, looks, strict=True)]))
    logs = np.log([[r.ratios[k] / r.ratios[-1], r.ratios[k] / r.preset] for r, k in zip(rows, looks, strict=True)])
    (full, preset), (worst, beside) = np.exp(logs.mean(0)), np.exp(logs.max(0))
    return steps, float(full), float(worst), float(preset), float(beside)


def score(rows: Sequence[Measured], looks: Sequence[int]) -> str:
    steps, *errors = outcome(rows, looks)
    return " | ".join([f"{steps:.0f}", *(f"{error:.3f}" for error in errors)])


if __name__ == "__main__":
    main()
