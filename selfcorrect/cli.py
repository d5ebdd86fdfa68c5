"""The command. The only file that prints: results to stdout, everything else to stderr."""

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import torch
from tqdm import tqdm

import denoisers
from selfcorrect import exr, files, metrics
from selfcorrect.correct import Result, correct
from selfcorrect.errors import FrameError, SelfcorrectError, SettingsError
from selfcorrect.frame import Frame
from selfcorrect.independence import doubts
from selfcorrect.settings import Settings
from selfcorrect.stages import uncorrelated

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; the exit code is 0, or 2 for input that the user can mend."""
    parser = _parser()
    try:
        options = parser.parse_args(arguments)
        options.run(options)
    except SelfcorrectError as error:
        _log(f"selfcorrect: error: {error}")
        return 2
    except KeyboardInterrupt:
        _log("selfcorrect: interrupted; nothing was written")
        return 130
    return 0


def _log(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


class _Parser(argparse.ArgumentParser):
    """One line for a wrong flag, like for every other wrong input."""

    def error(self, message: str) -> NoReturn:
        raise SettingsError(f"{message}; see {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="selfcorrect", description="Gives denoised Monte Carlo renders their detail back.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    frame = commands.add_parser("frame", help="correct one frame")
    frame.add_argument("a", metavar="A.exr", help="half a; FILE.exr::LAYER chooses a layer")
    frame.add_argument("b", metavar="B.exr", help="half b, rendered with another seed")
    frame.add_argument("-o", "--output", required=True, metavar="OUT.exr")
    frame.add_argument("--denoised-a", metavar="DA.exr", help="denoised half a, instead of a denoiser")
    frame.add_argument("--denoised-b", metavar="DB.exr")
    frame.add_argument("--denoised", metavar="D.exr", help="denoised mean of both halves")
    _add_run_flags(frame)
    frame.set_defaults(run=_frame)

    inspect = commands.add_parser("inspect", help="which channels a file has, and which would be used for what")
    inspect.add_argument("file", metavar="FILE.exr")
    inspect.add_argument("--json", action="store_true", help="one JSON object on stdout")
    inspect.set_defaults(run=_inspect)

    compare = commands.add_parser("compare", help="error of an image against one or two references")
    compare.add_argument("image", metavar="IMAGE.exr")
    compare.add_argument("reference", metavar="REF.exr")
    compare.add_argument("reference_b", metavar="REF2.exr", nargs="?", help="an independent second reference")
    compare.add_argument("--weight", metavar="SMOOTH.exr", help="smooth reference for the weight of relMSE")
    compare.add_argument("--seed", type=int, default=0, help="of the bootstrap")
    compare.add_argument("--json", action="store_true", help="one JSON object on stdout")
    compare.set_defaults(run=_compare)

    combine = commands.add_parser("combine", help="combine independent with correlated renders of one frame")
    combine.add_argument("independent", nargs=4, metavar="Y.exr", help="four renders with independent samples")
    combine.add_argument(
        "--correlated", nargs=4, required=True, metavar="Z.exr", help="four with common random numbers"
    )
    combine.add_argument("-o", "--output", required=True, metavar="OUT.exr")
    combine.add_argument("--samples", type=int, required=True, metavar="N", help="per pixel, of each render")
    combine.add_argument("--crossed", action="store_true", help="for a Z that was made from the Y of its number")
    combine.add_argument("--kernel", default=uncorrelated.KERNELS[0], choices=uncorrelated.KERNELS)
    combine.add_argument("--json", action="store_true", help="one JSON object on stdout")
    combine.set_defaults(run=_combine)

    demo = commands.add_parser("demo", help="correct the packaged frame and show what was gained")
    demo.add_argument("-o", "--output", metavar="DIR", help="keep the images here")
    _add_run_flags(demo)
    demo.set_defaults(run=_demo)
    return parser


def _add_run_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--denoiser", metavar="NAME", help=f"one of {' | '.join(denoisers.names())}")
    parser.add_argument("--preset", default=Settings.default(), help=" | ".join(Settings.presets()))
    parser.add_argument("--device", default="cpu", help="torch device: cpu, cuda, …")
    parser.add_argument("--threads", type=int, metavar="N", help="CPU threads, by default all")
    parser.add_argument("--map", action="append", default=[], metavar="ROLE=CHANNEL", help="albedo=MyAlbedo, …")
    parser.add_argument(
        "--aov", type=_aov_names, default=[], metavar="error,blend", help="also write what the guard found, as channels"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    group = parser.add_argument_group("settings, by default those of the preset")
    for f in fields(Settings):
        how: dict[str, Any] = {"type": type(f.default), "metavar": "|".join(f.metadata["choices"]) or "N"}
        if isinstance(f.default, bool):
            how = {"action": argparse.BooleanOptionalAction}
        presets = ", ".join(f"{name}: {getattr(s, f.name)}" for name, s in Settings.presets().items())
        group.add_argument(
            f"--{f.name.replace('_', '-')}", default=None, help=f"{f.metadata['help']} ({presets})", **how
        )


def _settings(options: argparse.Namespace) -> Settings:
    changes = {f.name: getattr(options, f.name) for f in fields(Settings)}
    return Settings.preset(options.preset, **{k: v for k, v in changes.items() if v is not None})


def _mapping(options: argparse.Namespace) -> dict[str, str]:
    pairs = [entry.partition("=") for entry in options.map]
    for role, equals, channel in pairs:
        if not (role and equals and channel):
            raise SettingsError(f"expected --map ROLE=CHANNEL, but got {role + equals + channel!r}")
    return {role: channel for role, _, channel in pairs}


def _use_machine(options: argparse.Namespace) -> None:
    if options.threads is not None:
        if options.threads < 1:
            raise SettingsError(f"expected --threads of at least 1, but got {options.threads}")
        torch.set_num_threads(options.threads)
    try:
        torch.empty(0, device=options.device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise SettingsError(
            f"expected a --device that this machine has, but got {options.device!r}: {reason}"
        ) from None


def _frame(options: argparse.Namespace) -> None:
    sources = files.Sources(
        options.a, options.b, options.denoised_a, options.denoised_b, options.denoised, _mapping(options)
    )
    report, _ = _run(options, sources, options.output)
    if options.json:
        print(json.dumps(report))


def _run(options: argparse.Namespace, sources: files.Sources, output: str) -> tuple[dict[str, Any], Frame]:
    """Correct one frame from files to file; returns what --json prints, and the frame."""
    start = time.perf_counter()
    settings = _settings(options)
    if options.aov and not settings.guard:
        raise SettingsError(f"expected the guard with --aov {','.join(options.aov)}, but got settings that turn it off")
    _use_machine(options)
    exr.check_target(output)
    denoise = None
    if options.denoiser is not None or sources.denoised_a is None:
        denoise = denoisers.create(options.denoiser or denoisers.default(), threads=options.threads)
    loaded = files.load(sources)
    seconds = {"read": time.perf_counter() - start}
    for role, names in loaded.taken.items():
        _log(f"{role}: {', '.join(names)}")
    for doubt in doubts(loaded.frame):
        _log(f"warning: {doubt}")
    frame, denoiser = _denoised(options, loaded.frame, denoise, seconds)
    for name, repairs in frame.repairs.items():
        if any(repairs):
            _log(f"{name}: {repairs.non_finite} pixels were NaN or infinite, {repairs.negative} negative; repaired")
    with _Progress() as progress:
        result = correct(frame.to(options.device), settings, progress=progress)
    written = time.perf_counter()
    estimate = None if result.estimate is None else asdict(result.estimate)
    details = {"preset": options.preset, "denoiser": denoiser, "version": version("selfcorrect"), "estimate": estimate}
    clipped = files.save(output, loaded, result, settings=settings, details=details, extra=_extra(options, result))
    if result.estimate is not None:
        _log(str(result.estimate))
    if clipped:
        _log(f"{output}: {clipped} values beyond the range of half floats were clipped")
    seconds |= result.seconds | {"write": time.perf_counter() - written, "total": time.perf_counter() - start}
    _log(f"{output}: written after {seconds['total']:.1f} s ({_spent(result)})")
    report = {
        "output": output,
        "settings": settings.to_dict(),
        **details,
        "channels": loaded.taken,
        "seconds": {name: round(value, 3) for name, value in seconds.items()},
        **_facts(frame, result),
    }
    return report, frame


def _facts(frame: Frame, result: Result) -> dict[str, Any]:
    """What --json tells of the frame and of the work done on it."""
    return {
        "size": {"width": frame.size[1], "height": frame.size[0]},
        "repairs": {name: repairs._asdict() for name, repairs in frame.repairs.items()},
        "input_scale": result.input_scale,
        "steps": len(result.losses),
        "parameters": 0 if result.network is None else sum(p.numel() for p in result.network.parameters()),
        "threads": torch.get_num_threads(),
    }


def _denoised(
    options: argparse.Namespace, frame: Frame, denoise: Callable[..., Any] | None, seconds: dict[str, float]
) -> tuple[Frame, str]:
    """The frame with denoised halves, and who denoised it; a denoiser that is named beats files found beside."""
    if frame.denoised is not None and options.denoiser is None:
        return frame, "given"
    assert denoise is not None  # created above, in every case that gets here
    start = time.perf_counter()
    name = options.denoiser or denoisers.default()
    _log(f"denoiser: {name}")
    frame = frame.denoise(denoise, full=frame.denoised_full is None)
    seconds["denoise"] = time.perf_counter() - start
    return frame, name


def _spent(result: Result) -> str:
    return ", ".join(f"{name} {value:.1f} s" for name, value in result.seconds.items())


def _extra(options: argparse.Namespace, result: Result) -> dict[str, Any]:
    """The maps that --aov asks for, as channels."""
    return {
        f"selfcorrect.{name}": image.cpu().numpy()
        for name, image in result.aovs.items()
        if name.partition(".")[0] in options.aov
    }


def _aov_names(text: str) -> list[str]:
    names = text.split(",")
    if not set(names) <= {"error", "blend"}:
        raise SettingsError(f"expected --aov error, blend or both, but got {text!r}")
    return names


class _Progress:
    """A bar on a terminal, a plain line for every tenth in a log."""

    def __init__(self) -> None:
        self._bar: Any = None

    def __enter__(self) -> "_Progress":
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, step: int, steps: int, loss: float) -> None:
        if sys.stderr.isatty():
            if self._bar is None:
                self._bar = tqdm(total=steps, desc="training", unit="step", file=sys.stderr)
            self._bar.set_postfix(loss=f"{loss:.4g}")
            self._bar.update(step - self._bar.n)
        elif step * 10 // steps > (step - 1) * 10 // steps:
            _log(f"training: step {step} of {steps}, loss {loss:.5g}")


def _inspect(options: argparse.Namespace) -> None:
    found = exr.inspect(options.file)
    if options.json:
        print(json.dumps(found.to_dict()))
    else:
        print("\n".join(found.lines()))


def _compare(options: argparse.Namespace) -> None:
    image, reference = (exr.load_half(path).buffers["color"] for path in (options.image, options.reference))
    reference_b, weight = (
        None if path is None else exr.load_half(path).buffers["color"] for path in (options.reference_b, options.weight)
    )
    try:
        result = metrics.compare(image, reference, reference_b, weight, seed=options.seed)
    except FrameError as error:
        raise FrameError(f"{options.image}: {error}") from None
    if options.json:
        # JSON has no infinity (the PSNR of equal images) and no NaN (the standard error of one tile)
        print(json.dumps({name: value if math.isfinite(value) else None for name, value in vars(result).items()}))
        return
    print(f"relMSE               {result.relmse:.6g} ± {result.relmse_standard_error:.2g}")
    print(f"PSNR (tone-mapped)   {result.psnr:.2f} dB")
    print(f"SSIM (tone-mapped)   {result.ssim:.4f}")
    print(f"FLIP                 {result.flip:.4f}")
    print(f"mean radiance ratio  {result.mean_radiance_ratio:.4f}")


def _combine(options: argparse.Namespace) -> None:
    start = time.perf_counter()
    exr.check_target(options.output)
    four = files.load_images([*options.independent, *options.correlated])
    image, gamma = uncorrelated.combine(
        four.images[:4],
        four.images[4:],
        samples=options.samples,
        crossed=options.crossed,
        kernel=options.kernel,
    )
    report = {"kernel": options.kernel, "gamma": gamma, "samples": options.samples, "crossed": options.crossed}
    clipped = files.save_combined(options.output, four, image, details=report)
    _log(f"{options.output}: written after {time.perf_counter() - start:.1f} s (gamma {gamma:g})")
    if clipped:
        _log(f"{options.output}: {clipped} values beyond the range of half floats were clipped")
    if options.json:
        print(json.dumps({"output": options.output, **report}))


def _demo(options: argparse.Namespace) -> None:
    """The main job on the packaged frame, with what it brought beside its references."""
    with resources.as_file(resources.files("selfcorrect") / "data") as data, tempfile.TemporaryDirectory() as away:
        folder = Path(options.output or away)
        folder.mkdir(parents=True, exist_ok=True)
        names = {
            name: str(data / f"demo_{name}.exr") for name in ("064spp_A", "064spp_B", "ref_A", "ref_B", "ref_smooth")
        }
        sources = files.Sources(names["064spp_A"], names["064spp_B"], mapping=_mapping(options))
        report, frame = _run(options, sources, str(folder / "corrected.exr"))
        color = [exr.load_half(names[n]).buffers["color"] for n in ("ref_A", "ref_B", "ref_smooth")]
        images = {
            "noisy": (frame.color[0] + frame.color[1]) / 2,
            "denoised": frame.denoised_full,
            "corrected": exr.load_half(report["output"]).buffers["color"],
        }
        report["relmse"] = {name: metrics.relmse(image, *color) for name, image in images.items()}
        report["mean"] = {name: metrics.mean_radiance_ratio(image, color[2]) for name, image in images.items()}
    if options.json:
        print(json.dumps(report))
        return
    for name in images:
        print(
            f"{name:10} relMSE {report['relmse'][name]:.5f}   mean radiance {report['mean'][name]:.4f} of the reference"
        )
    change = report["relmse"]["corrected"] / report["relmse"]["denoised"] - 1
    print(f"corrected against denoised: {change:+.0%}" + (f"; image in {folder}" if options.output else ""))
