"""What tensors on a device other than the CPU need of the host."""

import torch
from torch import Tensor

__all__ = ["on_device"]


def on_device(values: Tensor, device: torch.device) -> Tensor:
    """``values`` of the host, on ``device``; the host does not wait for what the device is still doing.

    From pageable memory it would: CUDA begins such a copy only when the stream is done. Pinned memory is kept by
    torch until the copy has been made.
    """
    if device.type != "cuda" or values.device.type == "cuda":
        return values.to(device)
    return values.pin_memory().to(device, non_blocking=True)
