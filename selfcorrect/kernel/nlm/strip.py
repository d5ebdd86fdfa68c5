"""What whoever uses the weights of non-local means works with: those of some rows."""

from dataclasses import dataclass

from torch import Tensor

__all__ = ["Strip"]


@dataclass(frozen=True)
class Strip:
    """Weights of the windows of some rows: (taps, rows, columns); the compiled form rounds columns up to a vector."""

    first_row: int
    weights: Tensor
