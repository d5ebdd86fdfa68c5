"""What the host hands to CUDA where the kernel is called, told by a driver that launches nothing.

Run in a process of its own, as Triton decides when it is imported whether it interprets: for each mode, prints whether
the program that is loaded is, bit by bit, the one that scripts/bench/gpu.py has in its table.
"""

import json
from typing import Any

import torch
import triton
from gpu_variants import EVERYTHING, source
from kernel import ALL, make_guides
from triton.backends.compiler import GPUTarget
from triton.runtime.driver import driver

from selfcorrect.kernel.cross_bilateral import Window, gpu, heads_count

TARGET = GPUTarget("cuda", 90, 32)


class StandIn:
    """A driver for a card that is not there: it keeps what it would load and launch."""

    def __init__(self) -> None:
        self.loaded: list[bytes] = []
        self.grids: list[tuple[int, ...]] = []
        self.utils = self

    def get_current_device(self) -> int:
        return 0

    def get_current_stream(self, device: int) -> int:
        return 0

    def get_current_target(self) -> GPUTarget:
        return TARGET

    def get_device_properties(self, device: int) -> dict[str, int]:
        return {"max_shared_mem": 48 << 10}

    def load_binary(self, name: str, program: bytes, shared: int, device: int) -> tuple[int, int, int, int, int]:
        self.loaded.append(program)
        return 0, 0, 0, 0, 1024

    def launcher_cls(self, source: Any, metadata: Any) -> Any:
        return lambda *arguments: self.grids.append(arguments[:3])


def main() -> None:
    card = StandIn()
    driver.set_active(card)
    guides = make_guides(48, ALL)
    raw = torch.zeros(2, heads_count(guides, "eq10"), 33, 37).requires_grad_()
    corners, window = torch.zeros(2, 2, dtype=torch.int64), Window(19)
    image = gpu.cross_bilateral(guides, raw, corners, window)
    image.sum().backward()
    gpu.cross_bilateral_loss(guides, raw, corners, guides.radiance, guides.planes[3].clone(), window)
    expected = [
        triton.compile(
            source(mode, EVERYTHING, window), target=TARGET, options={"num_warps": gpu.WARPS, "enable_fp_fusion": True}
        ).asm["cubin"]
        for mode in ("FORWARD", "BACKWARD", "LOSS")
    ]
    print(json.dumps({"same": [a == b for a, b in zip(card.loaded, expected, strict=True)], "grids": card.grids}))


if __name__ == "__main__":
    main()
