"""Intel Open Image Denoise, through the package mitsuba-oidn (extra ``oidn``).

Of the two bindings on PyPI, mitsuba-oidn sets the number of threads of a device, raises OIDN's errors as
exceptions, runs on Linux on x86-64 and aarch64, on Windows and on macOS, and takes 53 MB (19 MB more for
its Dr.Jit). pyoidn 2.5.1 bundles the same OIDN 2.5.1, but leaves errors to be polled, has no wheel for
Linux on aarch64, and takes 179 MB on Linux, most of it libraries for GPUs that are not used here.
"""

import torch

from selfcorrect.errors import DenoiserError

try:
    from mitsuba_oidn import Device, DeviceType, Error
except RuntimeError as error:  # of its thread pool, which needs a library that comes with compilers, not with Debian
    raise DenoiserError(f"OIDN does not load; on Debian and Ubuntu it needs libatomic1: {error}") from error

__all__ = ["MODES", "Oidn", "PrefilteringOidn", "oidn"]

MODES = {"oidn": "accurate", "oidn:fast": "fast", "oidn:none": "none"}
"""What OIDN does with albedo and normal, by the denoiser's specification; the modes' names are Blender's."""

_SCRATCH = 3 * 2**29  # bytes


class Oidn:
    """OIDN's ``RT`` filter on the CPU, HDR on, at its default (high) quality.

    OIDN has no model for a normal without an albedo: such a frame is denoised from its colour alone.
    The same input gives the same bits whatever was denoised before; another number of threads moves the
    result by some 1e-6 of its value.
    """

    # OIDN fills up its tiles of 16 with black, which pulls the right and bottom border down: a constant 50
    # came back as 9 on one pixel. Filled with the mirrored image it comes back as 50.
    multiple = 16
    features = frozenset({"albedo", "normal"})
    reads_only = True

    def __init__(
        self,
        threads: int | None = None,
        scratch: int | None = None,
        *,
        name: str = "oidn:none",
        clean_features: bool = False,
    ):
        """Open the device.

        Args:
            threads: of the CPU; None leaves the number to OIDN.
            scratch: bound of the filter's own memory, bytes: it goes through the image in tiles, with the same bits.
                It takes some 0.34 GiB at least. Left to itself it takes 1.1 GiB of 1920×1080, 2.9 GiB of 7680×4320.
            name: what messages call it.
            clean_features: OIDN's ``cleanAux``: albedo and normal are taken for noise-free, their detail is kept.
        """
        self.name = name
        self.scratch = scratch or _SCRATCH
        self.clean_features = clean_features
        self.device = Device(DeviceType.CPU)
        if threads is not None:
            self.device.num_threads = threads

    def denoise(self, color: torch.Tensor, albedo: torch.Tensor | None, normal: torch.Tensor | None) -> torch.Tensor:
        """Filter the colour (H, W, 3); OIDN itself clamps albedo to [0, 1] and normal to [-1, 1].

        The filter and its scratch memory are released on return, the device with this object.
        """
        images = {"color": color}
        if albedo is not None:
            images["albedo"] = albedo
            if normal is not None:
                images["normal"] = normal
        return self._filtered(images, hdr=True, clean_aux=self.clean_features and albedo is not None)

    def _filtered(self, images: dict[str, torch.Tensor], *, hdr: bool, clean_aux: bool) -> torch.Tensor:
        """The first of the images, filtered with the help of the others; of its shape and dtype."""
        output = torch.empty_like(next(iter(images.values())))
        try:
            rt = self.device.new_filter("RT")
            rt.hdr = hdr
            rt.clean_aux = clean_aux
            rt.max_memory_mb = max(self.scratch >> 20, 1)
            for name, image in (images | {"output": output}).items():
                rt.set_image(name, image)
            rt.execute()
        except Error as error:
            raise DenoiserError(f"denoiser {self.name}: {error}") from error
        return output


class PrefilteringOidn(Oidn):
    """OIDN as its documentation recommends for best quality: albedo and normal are denoised first."""

    def __init__(self, threads: int | None = None, scratch: int | None = None, *, name: str = "oidn"):
        """Open the device; see :class:`Oidn`."""
        super().__init__(threads, scratch, name=name, clean_features=True)

    def prefilter(
        self, albedo: torch.Tensor | None, normal: torch.Tensor | None
    ) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """Each feature denoised by the same filter with that image alone, of its own dtype.

        A normal without an albedo serves no denoising and is left as it is.
        """
        if albedo is None:
            return None, normal
        given = {"albedo": albedo} if normal is None else {"albedo": albedo, "normal": normal}
        clean = {name: self._filtered({name: image}, hdr=False, clean_aux=False) for name, image in given.items()}
        return clean["albedo"], clean.get("normal")


def oidn(spec: str, threads: int | None = None, scratch: int | None = None) -> Oidn:
    """The plug-in of a specification.

    Raises:
        DenoiserError: it is none of :data:`MODES`.
    """
    if spec not in MODES:
        *others, last = MODES
        raise DenoiserError(f"expected {', '.join(others)} or {last}, but got {spec!r}")
    if MODES[spec] == "accurate":
        return PrefilteringOidn(threads, scratch, name=spec)
    return Oidn(threads, scratch, name=spec, clean_features=MODES[spec] == "fast")
