"""Record what the compiled kernels give here, for replay.py to compare with on another machine.

    python scripts/wheels/record.py CALLS

Corrects a small frame of awkward size and denoises it by regression and non-local means, with the variant of every
kernel that all processors have, and keeps what went into each call and what came out.
"""

import argparse
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

import denoisers
from selfcorrect import Frame, Settings, correct
from selfcorrect.kernel.compiled import functions

WORK = (
    *("forward", "backward", "loss", "convolution_forward", "convolution_backward"),
    *("solve", "reconstruct", "nlm_weights", "nlm_average"),
)


def plain(value: Any) -> Any:
    """A call's argument without torch: tensors as copies in NumPy's arrays."""
    if isinstance(value, torch.Tensor):
        return value.detach().numpy().copy()
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def spied(name: str, real: Callable[..., None], calls: list[Any]) -> Callable[..., None]:
    """A kernel that keeps its arguments before and after."""

    def call(*arguments: Any) -> None:
        before = plain(arguments)
        real(*arguments)
        calls.append((name, before, plain(arguments)))

    return call


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calls", metavar="CALLS", type=Path, help="file to write")
    path = parser.parse_args().calls
    calls: list[Any] = []
    for name in WORK:
        setattr(functions, name, spied(name, getattr(functions, name), calls))
    functions.instruction_sets = functions.convolution_instruction_sets = lambda: ["baseline"]
    torch.set_num_threads(1)
    generator = torch.Generator().manual_seed(3)
    truth = torch.linspace(0.1, 1, 21 * 35 * 3).view(21, 35, 3)
    color = tuple(truth + 0.2 * torch.rand(21, 35, 3, generator=generator) for _ in "ab")
    frame = Frame(color=color, albedo=tuple((truth * 0.5).clone() for _ in "ab")).denoise(denoisers.create("nfor"))
    changes = {"steps": 3, "window": 5, "batch": 2, "patch": 16, "candidates": "none"}
    for preset in ("balanced", "paper"):
        correct(frame, Settings.preset(preset, **changes, precision="fp32"))
    correct(frame, Settings.preset("fast", stages="regression"))
    path.write_bytes(pickle.dumps(calls))
    print(f"{len(calls)} calls of {len({name for name, _, _ in calls})} functions")


if __name__ == "__main__":
    main()
