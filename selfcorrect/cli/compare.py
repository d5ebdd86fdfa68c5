"""The command `compare`: the error of an image against one or two references."""

import argparse
import math

from selfcorrect import exr, metrics
from selfcorrect.cli import memory
from selfcorrect.cli.compare_shot import compare_shot
from selfcorrect.cli.terminal import answer, log, show
from selfcorrect.errors import FrameError, SettingsError
from selfcorrect.exr.limits import check_alike

__all__ = ["run"]


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    if not -(2**63) <= options.seed < 2**63:
        raise SettingsError(f"expected a --seed of 64 bits, but got {options.seed}")
    if options.shot:
        compare_shot(options)
        return
    paths = [path for path in (options.image, options.reference, options.reference_b, options.weight) if path]
    check_alike(paths)
    if options.maxmem is not None:
        memory.check_compared(memory.parse_size(options.maxmem), paths)
    image, shown = exr.load_picture(options.image)
    half = exr.load_half(options.reference)
    reference, taken = half.buffers["color"], half.taken["color"]
    log(f"{options.image}: {', '.join(shown)}", f"{options.reference}: {', '.join(taken)}")
    reference_b, weight = (
        None if path is None else exr.load_half(path).buffers["color"] for path in (options.reference_b, options.weight)
    )
    try:
        result = metrics.compare(image, reference, reference_b, weight, seed=options.seed)
    except FrameError as error:
        raise FrameError(f"{options.image}: {error}") from None
    if options.json:
        # JSON has no infinity (the PSNR of equal images) and no NaN (the standard error of one tile)
        values = {name: value if math.isfinite(value) else None for name, value in vars(result).items()}
        answer({**values, "channels": {"image": shown, "reference": taken}})
        return
    show(
        f"relMSE               {result.relmse:.6g} ± {result.relmse_standard_error:.2g}",
        f"PSNR (tone-mapped)   {result.psnr:.2f} dB",
        f"SSIM (tone-mapped)   {result.ssim:.4f}",
        f"FLIP                 {result.flip:.4f}",
        f"mean radiance ratio  {result.mean_radiance_ratio:.4f}",
    )
