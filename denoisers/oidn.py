"""Intel Open Image Denoise, through the package mitsuba-oidn (extra ``oidn``).

Of the two bindings on PyPI, mitsuba-oidn sets the number of threads of a device, raises OIDN's errors as
exceptions, runs on Linux on x86-64 and aarch64, on Windows and on macOS, and takes 53 MB (19 MB more for
its Dr.Jit). pyoidn 2.5.1 bundles the same OIDN 2.5.1, but leaves errors to be polled, has no wheel for
Linux on aarch64, and takes 179 MB on Linux, most of it libraries for GPUs that are not used here.
"""

import torch
from mitsuba_oidn import Device, DeviceType, Error

from selfcorrect.errors import DenoiserError

__all__ = ["Oidn"]


_SCRATCH = 3 * 2**29  # bytes


class Oidn:
    """OIDN's ``RT`` filter on the CPU, HDR on, at its default (high) quality.

    OIDN has no model for a normal without an albedo: such a frame is denoised from its colour alone.
    The same input gives the same bits whatever was denoised before; another number of threads moves the
    result by some 1e-6 of its value.
    """

    name = "oidn"
    # OIDN fills up its tiles of 16 with black, which pulls the right and bottom border down: a constant 50
    # came back as 9 on one pixel. Filled with the mirrored image it comes back as 50.
    multiple = 16
    features = frozenset({"albedo", "normal"})
    reads_only = True

    def __init__(self, threads: int | None = None, scratch: int | None = None):
        """``scratch`` bounds the filter's own memory, bytes: it goes through the image in tiles, with the same bits.

        It takes some 0.34 GiB at least. Left to itself it takes 1.1 GiB of 1920×1080, 2.9 GiB of 7680×4320.
        """
        self.scratch = scratch or _SCRATCH
        self.device = Device(DeviceType.CPU)
        if threads is not None:
            self.device.num_threads = threads

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        """Filter the colour (H, W, 3); OIDN itself clamps albedo to [0, 1] and normal to [-1, 1].

        The filter and its scratch memory are released on return, the device with this object.
        """
        output = torch.empty_like(color)
        images = {"color": color, "output": output}
        if albedo is not None:
            images["albedo"] = albedo
            if normal is not None:
                images["normal"] = normal
        try:
            rt = self.device.new_filter("RT")
            rt.hdr = True
            rt.max_memory_mb = max(self.scratch >> 20, 1)
            for name, image in images.items():
                rt.set_image(name, image)
            rt.execute()
        except Error as error:
            raise DenoiserError(f"denoiser oidn: {error}") from error
        return output
