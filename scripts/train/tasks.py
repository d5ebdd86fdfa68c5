"""What each network is, what it is shown, what its loss is, and what it is measured by.

All losses are relative squared errors, weighted so that no few views decide everything; how outliers of noisy targets
are met without teaching to darken: see :mod:`samples`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from dataset import View
from denoiser import MULTIPLE, Denoiser
from samples import HALVES, SINGLES, WHOLE, Memory, Sample, draw, level_of
from torch import Tensor, nn
from torch.nn import functional as F

from selfcorrect.frame import Half
from selfcorrect.stages.bilateral_combiner import BilateralCombiner
from selfcorrect.stages.deep_combiner import DeepCombiner
from selfcorrect.stages.james_stein import james_stein, relative_weight, variance_of_mean
from selfcorrect.stages.neural_james_stein import VarianceNetwork, neural_blend, tau_loss
from selfcorrect.stages.regression import cross_buffer_regression

__all__ = ["TASKS", "Judged", "Task", "task_of"]

_REGRESSION_STRIDE = 4  # of the biased images in training: a view takes 0.1 s
_PAIRS = (((0, 1), 4), ((2, 3), 5), (HALVES, WHOLE))
"""Inputs of equal noise, and the number of their mean."""
_BLURRED = 11  # pixels, side of the box that makes a bad biased image
_LEAST_ERROR = 1e-4  # of a view's inputs: that of a target of 256 samples is not less


class Judged(NamedTuple):
    """Linear radiance (H, W, 3) of a validation view: the network's, what it should beat, and the noisy image."""

    result: Tensor
    baseline: Tensor
    noisy: Tensor


class Task(Protocol):
    """One network's training."""

    baseline: str
    """What the validation compares with."""

    def build(self) -> nn.Module:
        """A new network; its attribute ``architecture`` holds the arguments that rebuild it."""
        ...

    def sample(self, number: int, memory: Memory, generator: torch.Generator) -> Sample:
        """A training sample of view ``number``."""
        ...

    def losses(self, network: nn.Module, batch: Sample) -> Tensor:
        """The loss of each sample of a batch, (N,), with its weight."""
        ...

    def judge(self, network: nn.Module, view: View) -> list[Judged]:
        """The network's results on a view."""
        ...


def relative_squared(result: Tensor, target: Tensor, level: Tensor) -> Tensor:
    """Relative L2 of each image of (N, 3, H, W) with the weight of the level, (N,)."""
    return (((result.float() - target) ** 2).mean(1) / (level.mean(1) ** 2 + 0.01)).mean((1, 2))


class DenoiserTask:
    """Sub-images, halves and frames in turn; relative L2 to what OIDN makes of the frame, so mostly of more samples.

    On noisy targets it came to 6.5 times OIDN's error and 10 % too little light in 12 minutes; after six more with this
    teacher it was at 2.8 times: a network that makes all of an image has much to learn, one that mixes images little.
    It cannot become better than its teacher.
    """

    baseline = "oidn"

    def __init__(self, architecture: dict[str, Any], seed: int, crop: int):
        self.architecture, self.seed, self.crop = architecture, seed, crop

    def build(self) -> nn.Module:
        """See :class:`Task`."""
        torch.manual_seed(self.seed)
        return Denoiser(**self.architecture).to(memory_format=torch.channels_last)

    def sample(self, number: int, memory: Memory, generator: torch.Generator) -> Sample:
        """See :class:`Task`."""
        return draw(memory, (_input(generator),), "oidn", generator, crop=self.crop, taught=True)

    def losses(self, network: nn.Module, batch: Sample) -> Tensor:
        """See :class:`Task`; the network undoes the exposure of the batch, so it gets its own."""
        exposure = torch.stack([level_of(image) for image in batch.level])[:, None, None, None]
        result = network(batch.noisy[:, 0], batch.albedo, batch.normal, exposure)
        return relative_squared(result, batch.target, batch.level) * batch.importance

    def judge(self, network: nn.Module, view: View) -> list[Judged]:
        """See :class:`Task`."""
        noisy = view.color[:4].mean(0)
        planes = (_planes(noisy), _planes(view.albedo), _planes(view.normal))
        height, width = noisy.shape[:2]
        pad = (0, -width % MULTIPLE, 0, -height % MULTIPLE)
        result = network(*(F.pad(image, pad, mode="replicate") for image in planes))[:, :, :height, :width]
        return [Judged(_image(result), view.denoised["oidn"][WHOLE], noisy)]


class CombinerTask:
    """Noisy and denoised images of all of a view's denoisers; relative L2 over the better input's.

    Over the better input's, since the errors of views differ by factors of a thousand: so each view counts for the
    share of its error that could be gained, and 1 minus the loss is that gain.
    """

    baseline = "denoised"

    def __init__(self, architecture: dict[str, Any], seed: int, crop: int):
        self.architecture, self.seed, self.crop = architecture, seed, crop
        self.buffers = int(architecture.get("buffers", 1))

    def build(self) -> nn.Module:
        """See :class:`Task`."""
        return DeepCombiner(**self.architecture, seed=self.seed)

    def sample(self, number: int, memory: Memory, generator: torch.Generator) -> Sample:
        """See :class:`Task`."""
        keys = (_input(generator),) if self.buffers == 1 else _drawn(SINGLES, self.buffers, generator)
        denoiser = _other(memory, int(torch.randint(2**31 - 1, (), generator=generator)))
        return draw(memory, keys, denoiser, generator, crop=self.crop)

    def losses(self, network: nn.Module, batch: Sample) -> Tensor:
        """See :class:`Task`."""
        result = network(batch.noisy, batch.denoised, batch.features)
        inputs = (batch.denoised.mean(1), batch.noisy.mean(1))
        start = torch.stack([relative_squared(image, batch.target, batch.level) for image in inputs]).amin(0)
        return relative_squared(result, batch.target, batch.level) / (start + _LEAST_ERROR)

    def judge(self, network: nn.Module, view: View) -> list[Judged]:
        """See :class:`Task`; one result for each denoiser."""
        keys = (WHOLE,) if self.buffers == 1 else SINGLES[: self.buffers]
        memory = Memory.of(view)
        depth = memory.depth.float() / memory.depth.float().max().clamp(min=1e-6)
        features = torch.cat([memory.normal.float(), memory.albedo.float(), depth])[None]
        found = []
        for images in view.denoised.values():
            scale = 1 / level_of(images[WHOLE].movedim(-1, 0))
            noisy = memory.noisy(keys)[None] * scale
            result = network(noisy, images[list(keys)].movedim(-1, 1)[None] * scale, features) / scale
            found.append(Judged(_image(result), images[WHOLE], view.color[:4].mean(0)))
        return found


class BilateralCombinerTask(CombinerTask):
    """The same for the combiner with bilateral weights."""

    def build(self) -> nn.Module:
        """See :class:`Task`."""
        return BilateralCombiner(**self.architecture, seed=self.seed)


class JamesSteinTask:
    """Two inputs of equal noise whose mean is X; Eq. 14 to first order around the inputs denoised.

    Eq. 14 takes τ of the target, and the mean of a curve of noise is not the curve of its mean: with noisy targets it
    darkens (at a relative noise of 1 by a third). So τ is taken as straight around the denoised inputs, which keeps
    what it is for, less weight on the brightest pixels, and costs no bias.

    The biased images are what the stage may get: regressions as the paper's (four times of ten); the denoised inputs,
    moved so that their mean is the denoised mean (three); one and the same denoised image twice, as where a half is
    shrunk (two); and the inputs under a box filter (one): it has to meet bad ones, too.
    """

    baseline = "classical James–Stein"

    def __init__(self, architecture: dict[str, Any], seed: int, crop: int):
        self.architecture, self.seed, self.crop = architecture, seed, crop
        self._regressions: dict[tuple[int, tuple[int, ...], str], Tensor] = {}

    def build(self) -> nn.Module:
        """See :class:`Task`."""
        return VarianceNetwork(**self.architecture, seed=self.seed)

    def sample(self, number: int, memory: Memory, generator: torch.Generator) -> Sample:
        """See :class:`Task`."""
        kind = float(torch.rand((), generator=generator))
        if kind < 0.4:  # few of all possible pairs: each is kept, for it takes a while
            keys = HALVES if number % 2 else SINGLES[::2]
            biased = self._regression(number, memory, keys, "oidn" if number % 4 < 2 else _other(memory, number))
            return draw(memory, keys, "oidn", generator, crop=self.crop, biased=biased)
        keys, whole = _PAIRS[int(torch.randint(len(_PAIRS), (), generator=generator))]
        images = memory.denoised[_denoiser(memory, generator)].float()
        if kind < 0.7:
            biased = _moved(images, keys, whole)
        elif kind < 0.9:
            biased = images[[whole, whole]]
        else:
            biased = _blurred(memory.noisy(keys))
        return draw(memory, keys, "oidn", generator, crop=self.crop, biased=biased)

    def _regression(self, number: int, memory: Memory, keys: tuple[int, ...], denoiser: str) -> Tensor:
        key = (number, keys, denoiser)
        if key not in self._regressions:
            self._regressions[key] = _regressed(memory, keys, denoiser).half()
        return self._regressions[key].float()

    def losses(self, network: nn.Module, batch: Sample) -> Tensor:
        """See :class:`Task`."""
        theta = _blend(network, batch.noisy, batch.biased)
        each = zip(theta, batch.target, batch.level, strict=True)
        losses = torch.stack([tau_loss(t[None], target[None], level[None]) for t, target, level in each])
        return losses * batch.importance

    def judge(self, network: nn.Module, view: View) -> list[Judged]:
        """See :class:`Task`; with OIDN's images as the stage gets them, their regression, and a box filter."""
        memory = Memory.of(view)
        noisy = memory.noisy(HALVES)
        scale = 1 / level_of(view.denoised["oidn"][WHOLE].movedim(-1, 0))
        found = []
        denoised = _moved(memory.denoised["oidn"].float(), HALVES, WHOLE)
        for biased in (denoised, _regressed(memory, HALVES, "oidn"), _blurred(noisy)):
            theta = _blend(network, noisy[None] * scale, biased[None] * scale) / scale
            x, y = ((image.mean(0) * scale).movedim(0, -1) for image in (noisy, biased))
            variance = variance_of_mean((_image(noisy[:1] * scale), _image(noisy[1:] * scale)))
            classical = james_stein(x, y, variance, relative_weight(x)) / scale
            found.append(Judged(_image(theta), classical, view.color[:4].mean(0)))
        return found


def _blend(network: nn.Module, noisy: Tensor, biased: Tensor) -> Tensor:
    """θ of (N, 2, 3, H, W) inputs and biased images."""
    x, variance = noisy.mean(1), ((noisy[:, 0] - noisy[:, 1]) / 2) ** 2
    y_a, y_b = biased.unbind(1)
    weights, alpha = network(x, variance, y_a, y_b)
    return neural_blend(weights, alpha, x, variance, y_a, y_b)


def _regressed(memory: Memory, keys: tuple[int, ...], denoiser: str) -> Tensor:
    """Y^A and Y^B (2, 3, H, W) as the stage makes them, at a mean near 1 and back."""
    images = memory.denoised[denoiser][list(keys)].float()
    scale = 1 / level_of(images.mean(0))
    shared = [image.float().movedim(0, -1).contiguous() for image in (memory.albedo, memory.normal, memory.depth)]

    def half(noisy: Tensor, denoised: Tensor) -> Half:
        color, image = (((plane * scale).movedim(0, -1)).contiguous() for plane in (noisy, denoised))
        return Half(color, image, shared[0], shared[1], None, shared[2])

    a, b = (half(*each) for each in zip(memory.noisy(keys), images, strict=True))
    fits = cross_buffer_regression((a, b), stride=_REGRESSION_STRIDE, threads=torch.get_num_threads())
    return torch.stack([fit.movedim(-1, 0) for fit in fits]) / scale


def _moved(images: Tensor, keys: tuple[int, ...], whole: int) -> Tensor:
    """Denoised inputs (2, 3, H, W) and what the denoised mean has beyond their mean, as in the stage."""
    pair = images[list(keys)]
    return pair + (images[whole] - pair.mean(0))


def _blurred(images: Tensor) -> Tensor:
    padded = F.pad(images, (_BLURRED // 2,) * 4, mode="reflect")
    return F.avg_pool2d(padded, _BLURRED, 1)


def _input(generator: torch.Generator) -> int:
    """The number of an input: a sub-image, a half, each four times of ten, or the frame."""
    kind = int(torch.randint(10, (), generator=generator))
    numbers = SINGLES if kind < 4 else HALVES if kind < 8 else (WHOLE,)
    return _drawn(numbers, 1, generator)[0]


def _drawn(numbers: tuple[int, ...], count: int, generator: torch.Generator) -> tuple[int, ...]:
    return tuple(numbers[i] for i in torch.randperm(len(numbers), generator=generator)[:count].tolist())


def _denoiser(memory: Memory, generator: torch.Generator) -> str:
    """OIDN half of the time."""
    if torch.rand((), generator=generator) < 0.5:
        return "oidn"
    return _other(memory, int(torch.randint(2**31 - 1, (), generator=generator)))


def _other(memory: Memory, number: int) -> str:
    others = sorted(memory.denoised)
    return others[number % len(others)]


def _planes(image: Tensor) -> Tensor:
    return image.movedim(-1, 0)[None]


def _image(planes: Tensor) -> Tensor:
    return planes[0].float().movedim(0, -1)


TASKS: dict[str, tuple[Callable[[dict[str, Any], int, int], Task], dict[str, Any]]] = {
    "denoiser": (DenoiserTask, {}),
    "james-stein": (JamesSteinTask, {}),
    "bilateral-combiner": (BilateralCombinerTask, {}),
    "deep-combiner": (CombinerTask, {"buffers": 1}),
    "deep-combiner-4": (CombinerTask, {"buffers": 4}),
}
"""By network: its task and the architecture that is fixed."""


def task_of(network: str, architecture: dict[str, Any], seed: int, crop: int) -> Task:
    """The task of a network of this architecture."""
    task, fixed = TASKS[network]
    return task({**architecture, **fixed}, seed, crop)
