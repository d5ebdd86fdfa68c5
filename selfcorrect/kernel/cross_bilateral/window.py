"""What the kernel's sums run over, and what they make of it."""

from dataclasses import dataclass, replace

from selfcorrect.errors import SettingsError
from selfcorrect.settings import Settings

__all__ = ["LARGEST_WINDOW", "Window"]

LARGEST_WINDOW = 31


@dataclass(frozen=True)
class Window:
    """The neighbours of each pixel, and the equation they are combined by.

    Attributes:
        side: pixels, odd, 1 … 31.
        every: 1 takes all taps; n > 1 a lattice of one in n, the centre's weight divided by n.
        combination: "eq10", or "eq3" for z_c + Σ w_i (y_i − z_i) / Σ w_i.

    Raises:
        SettingsError: a value is out of range.
    """

    side: int
    every: int = 1
    combination: str = "eq10"

    def __post_init__(self) -> None:
        if self.side % 2 == 0 or not 1 <= self.side <= LARGEST_WINDOW:
            raise SettingsError(f"expected an odd window from 1 to {LARGEST_WINDOW}, but got {self.side}")
        if self.every < 1:
            raise SettingsError(f"expected one tap in 1 or more, but got one in {self.every}")
        if self.combination not in ("eq3", "eq10"):
            raise SettingsError(f"expected the combination eq3 or eq10, but got {self.combination}")

    @classmethod
    def of(cls, settings: Settings) -> "Window":
        """That of training."""
        return cls(settings.window, settings.taps_every, settings.combination)

    @property
    def whole(self) -> "Window":
        """The same with all taps, as inference takes it."""
        return replace(self, every=1)

    @property
    def radius(self) -> int:
        """Pixels to each side of the centre."""
        return self.side // 2

    @property
    def neighbours(self) -> list[tuple[int, int]]:
        """(dy, dx) of the taps but the centre: dx = slope · dy modulo ``every``, a lattice spread over all rows."""
        slope = 1 if self.every < 4 else 2
        line = range(-self.radius, self.radius + 1)
        return [(dy, dx) for dy in line for dx in line if (dy or dx) and (dx - slope * dy) % self.every == 0]
