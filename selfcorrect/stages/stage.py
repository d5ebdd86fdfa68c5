"""What a stage is: one step from a state of a frame to the next, so that stages compose in any order.

A stage gives halves and a full image, as it was given. Its half a is made from half a alone, so that half b stays its
witness, for the core's loss and for the guard behind the last stage. The full image may use both halves. Where the two
need different formulas, the halves' is the poorer one and the guard errs on the safe side.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from torch import Tensor

from selfcorrect.frame import Frame
from selfcorrect.image.repair import Repairs
from selfcorrect.settings import Settings
from selfcorrect.stages.core.network import Network
from selfcorrect.stages.core.train import Progress
from selfcorrect.stages.images import StageImages

__all__ = ["Extra", "Keep", "Learned", "Outcome", "Stage", "Start", "Work"]

Keep = Callable[[slice, tuple[Tensor, Tensor]], None]
"""Takes rows and what a stage made there of each half, of radiance times the state's scale."""


class Start(NamedTuple):
    """What training began from.

    Attributes:
        warm: from the network that was given, not from a new one.
        cold_loss: Eq. 8 of a new network on a sample of the frame; None where no network was given.
        warm_loss: the same of the network that was given.
    """

    warm: bool
    cold_loss: float | None = None
    warm_loss: float | None = None


class Learned(NamedTuple):
    """A network optimised on a frame, how it began, and Eq. 8 before each step."""

    network: Network
    start: Start
    losses: list[float]


class Outcome(NamedTuple):
    """What a stage gives.

    Attributes:
        state: after it.
        learned: on this frame, for the next frame of a shot to start from; None where nothing is learned.
        seconds: of its parts, by name; empty where it has none.
    """

    state: StageImages
    learned: Learned | None = None
    seconds: Mapping[str, float] = MappingProxyType({})


@dataclass(frozen=True)
class Work:
    """What a stage is given beside the images.

    Attributes:
        warm_start: the network of the last frame.
        progress: called as ``progress(step, steps, loss)`` after every optimiser step.
        stop: asked before every optimiser step; when it says True, training ends.
        extra: what the stage's :class:`Extra` made for this frame, on the device that the images are on.
        keep: given to the last stage, if anybody wants its halves: a stage that makes them a strip of rows at a time
            hands them over here and need not hold them; then the halves of its outcome are those it was given.
    """

    warm_start: Network | None = None
    progress: Progress | None = None
    stop: Callable[[], bool] | None = None
    extra: Any = None
    keep: Keep | None = None


class Images(Protocol):
    """What an :class:`Extra` makes of the images it was given."""

    @property
    def repairs(self) -> dict[str, Repairs]:
        """Counts of repaired pixels, by a name for the log."""
        ...

    def denoise(self, frame: Frame, denoiser: Callable[..., Any]) -> "Images":
        """These with their denoised images."""
        ...

    def to(self, device: str | torch.device) -> "Images":
        """These with all their tensors on ``device``."""
        ...


@dataclass(frozen=True)
class Extra:
    """Images beyond the halves that a stage needs, which the command takes by a flag of its own.

    Attributes:
        flag: of the command ``frame``.
        files: what help calls each.
        help: of the flag.
        of: checks the images against a frame and makes what the stage is given.
    """

    flag: str
    files: tuple[str, ...]
    help: str
    of: Callable[[Frame, Sequence[Any]], Images]


class Stage(ABC):
    """A stage with its weights opened; used for any number of frames.

    Attributes:
        name: in the settings' ``stages``.
        learns: on the frame itself, so that a warm start makes sense.
        on_cpu: it works there, wherever the frame's buffers lie.
        first_only: it reads what the denoiser gave, so that no other stage may come before it.
        extra: images that it needs beyond the halves.
    """

    name: ClassVar[str]
    learns: ClassVar[bool] = False
    on_cpu: ClassVar[bool] = False
    first_only: ClassVar[bool] = False
    extra: ClassVar[Extra | None] = None

    def __init__(self, settings: Settings):
        """Open what the stage needs from disk.

        Raises:
            FileError: weights are missing or do not fit.
        """
        self.settings = settings

    @abstractmethod
    def run(self, state: StageImages, work: Work) -> Outcome:
        """One step on."""
