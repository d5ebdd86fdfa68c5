"""Squared bias and relMSE of the uncorrelated weighting and its baselines, from independent rounds of renders.

    .venv/bin/python scripts/bench/uncorrelated.py ROUNDS [SCENES/NAME/scene.xml ...] [--rounds 100] [--spp 8]
    .venv/bin/python scripts/bench/uncorrelated.py ROUNDS SCENE.xml --of 128         # the whole field of view, small
    .venv/bin/python scripts/bench/uncorrelated.py ROUNDS SCENE.xml --symmetric      # is the bias due to skewed noise?

Of each scene (the Cornell box, where none is named) the 128×128 pixels in the middle of a frame ``--of`` so many pixels
wide: what common random numbers are worth depends on how much of the scene a window of 15×15 pixels sees. Every round
renders four images with independent samples and four with common random numbers, of seeds of their own. A round is a
file in the folder ROUNDS: a killed run goes on where it was, and images that a file lacks are made from its renders.

y is unbiased, so that the other rounds' y serve as the reference, and the noise of all is taken out: the relMSE of a
round's μ is |μ − ȳ|² − s²/(n − 1) with the mean ȳ and the sample variance s² of the y of the n − 1 other rounds; the
squared bias is the mean of d·d' over all pairs of *different* rounds, of d = μ − y. Both are over mean_rgb(ȳ)² + 0.01.
Behind ± are standard errors, of the bias from a jackknife over the rounds; z has no bias, and its row shows what is
noise. The share in common is the variance of the mean error of a window over that of a pixel's: 1 where all pixels of a
window err alike, 1/225 where their noise is independent. ``--symmetric`` adds the uncorrelated weighting of noise that
is as large but not skewed: in every other round z is mirrored, at the mean y of the other rounds that are mirrored; of
m such rounds that leaves −1/(m − 1)² of y's relMSE in the squared bias. Needs the extra ``render`` and an LLVM library.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from selfcorrect.image.windows import box_mean
from selfcorrect.settings import Settings
from selfcorrect.stages.deep_combiner import Combiner, combine_whole, feature_planes, opened_network
from selfcorrect.stages.uncorrelated import KERNELS, WINDOW, combine

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "render"))

import variants
from screened_poisson import screened_poisson

Image = np.ndarray[Any, Any]
_FEATURE_SPP = 16
_BOX = "cornell-box"


class Place(NamedTuple):
    """One field of view."""

    name: str
    scenes: tuple[Any, Any]  # with independent samples, with common random numbers
    features: Image  # (H, W, 7): albedo, normal, depth


def main() -> None:
    options = parse()
    torch.set_num_threads(1)
    if variants.failure() is not None:
        raise SystemExit(variants.refusal("common random numbers"))
    crn = importlib.import_module("common_random_numbers")  # fails where there is no LLVM library
    settings = Settings()
    network = opened_network("deep-combiner", settings, "combiner_weights", "deep-combiner", pairs=1)
    for path in options.scenes or [None]:
        place = opened(crn, path, options)
        rounds = [round_of(crn, place, number, network, options) for number in range(options.rounds)]
        if options.symmetric:
            add_symmetric(rounds, place, options)
        print(f"\n{place.name}, {options.rounds} rounds, 4 x {options.spp} spp of each kind, of {options.of} pixels")
        print("\n".join(table(rounds)), flush=True)


def opened(crn: Any, path: Path | None, options: argparse.Namespace) -> Place:
    """The scene's field of view."""
    kind = _BOX if path is None else path.parent.name
    name = f"{kind}-{options.of}-{options.size}-{options.spp}spp"
    scenes = tuple(_scene(crn, path, options, common=common) for common in (False, True))
    return Place(name, (scenes[0], scenes[1]), _features(scenes[0]))


def _scene(crn: Any, path: Path | None, options: argparse.Namespace, *, common: bool) -> Any:
    if path is None:
        scene = crn.cornell_box(common=common, size=options.of)
    else:
        load = importlib.import_module("render_mitsuba").load_scene
        scene = load(path, {}, (options.of, options.of), "common_random_numbers" if common else "independent")
    film = crn.mi.traverse(scene.sensors()[0])
    film["film.crop_size"] = [options.size] * 2
    film["film.crop_offset"] = [(options.of - options.size) // 2] * 2
    film.update()
    return scene


def _features(scene: Any) -> Image:
    mi = importlib.import_module("mitsuba")
    aovs = {"type": "aov", "aovs": "albedo:albedo,nn:sh_normal,dd:depth"}
    return np.array(mi.render(scene, integrator=mi.load_dict(aovs), spp=_FEATURE_SPP, seed=0))[..., -7:]


def round_of(crn: Any, place: Place, number: int, network: Combiner, options: argparse.Namespace) -> dict[str, Image]:
    """The images of a round by name; what its file lacks is made."""
    file = _file(place, number, options)
    found = dict(np.load(file)) if file.exists() else {}
    if not found:
        for kind, scene, first in (("y", place.scenes[0], 8 * number), ("z", place.scenes[1], 8 * number + 4)):
            found[f"renders {kind}"] = np.stack([crn.render(scene, options.spp, first + i) for i in range(4)])
    before = set(found)
    for name, image in missing(found, place.features, network, options.spp):
        found[name] = image.astype(np.float32)
    if set(found) != before:
        _saved(file, found)
    return {name: image for name, image in found.items() if not name.startswith("renders")}


def missing(found: dict[str, Image], features: Image, network: Combiner, spp: int) -> Iterator[tuple[str, Image]]:
    """What each method makes of four independent and four correlated renders, where it is not there yet."""
    y, z = found["renders y"], found["renders z"]
    if "y" not in found:
        yield "y", y.mean(0)
        yield "z", z.mean(0)
    independent, correlated = (tuple(torch.from_numpy(image) for image in four) for four in (y, z))
    for kernel in KERNELS:
        if kernel not in found:
            yield kernel, combine(independent, correlated, samples=spp, kernel=kernel)[0].numpy()
    crossed = "uncorrelated, screened Poisson crossed"
    if crossed not in found:
        poisson = [screened_poisson(own, common) for own, common in zip(y, z, strict=True)]
        yield "screened Poisson", np.mean(poisson, 0)
        made = tuple(torch.from_numpy(image) for image in poisson)
        yield crossed, combine(independent, made, samples=spp, crossed=True)[0].numpy()
    if "deep combiner, as shipped" not in found:
        yield "deep combiner, as shipped", deep_combined(network, y.mean(0), z.mean(0), features)


def deep_combined(network: Combiner, y: Image, z: Image, features: Image) -> Image:
    """The deep combiner's image of the pair, at the exposure that the tool would bring it to."""
    albedo, normal, depth = (torch.from_numpy(part) for part in np.split(features, [3, 6], -1))
    planes = feature_planes((y.shape[0], y.shape[1]), normal=normal, albedo=albedo, depth=depth)
    scale = 1 / float(np.sqrt(z.clip(min=0).mean(-1)).mean() ** 2)
    return combine_whole(network, (torch.from_numpy(y),), (torch.from_numpy(z),), planes, scale=scale).numpy()


def add_symmetric(rounds: list[dict[str, Image]], place: Place, options: argparse.Namespace) -> None:
    """Add to each round the uncorrelated weighting, of every other one with z's noise turned round."""
    others = np.sum([made["y"] for made in rounds[1::2]], 0)
    for number, made in enumerate(rounds):
        image = made["uncorrelated"]
        if number % 2:
            renders = np.load(_file(place, number, options))
            y, z = (torch.from_numpy(renders[f"renders {kind}"]).unbind() for kind in "yz")
            middle = torch.from_numpy((others - made["y"]) / (len(rounds) // 2 - 1))
            image = combine(y, tuple(2 * middle - one for one in z), samples=options.spp)[0].numpy()
        made["uncorrelated, noise of z made symmetric"] = image


def table(rounds: list[dict[str, Image]]) -> list[str]:
    """Markdown, a row for each method."""
    y = np.stack([made["y"] for made in rounds]).astype(np.float64)
    weight = 1 / (y.mean(0).mean(-1, keepdims=True) ** 2 + 0.01)
    lines = ["| | relMSE | squared bias | share in common |", "|---|---|---|---|"]
    for name in rounds[0]:
        images = np.stack([made[name] for made in rounds]).astype(np.float64)
        measured = relmse(images, y, weight), squared_bias(images - y, weight)
        cells = [f"{value:.2e} ± {error:.0e}" for value, error in measured]
        lines.append(f"| {name} | {' | '.join(cells)} | {in_common(images, weight):.2f} |")
    return lines


def relmse(images: Image, y: Image, weight: Image) -> tuple[float, float]:
    """Of (n, H, W, 3) images by the y of the other rounds, without their noise; and its standard error."""
    count = len(y)
    others = (y.sum(0) - y) / (count - 1)
    deviation = ((y - y.mean(0)) ** 2).sum(0) - (y - y.mean(0)) ** 2 * (count / (count - 1))
    noise = deviation / ((count - 2) * (count - 1))
    each = (weight * ((images - others) ** 2 - noise)).mean((1, 2, 3))
    return float(each.mean()), float(each.std(ddof=1)) / count**0.5


def squared_bias(differences: Image, weight: Image) -> tuple[float, float]:
    """Mean product of different rounds' μ − y, (n, H, W, 3); and its standard error."""
    count, total = len(differences), differences.sum(0)
    own = (weight * differences**2).mean((1, 2, 3))
    with_all = np.array([(weight * total * each).mean() for each in differences])
    pairs = float(with_all.sum() - own.sum())  # ordered pairs of different rounds
    without = (pairs - 2 * (with_all - own)) / ((count - 1) * (count - 2))
    return pairs / (count * (count - 1)), float(np.sqrt((count - 1) * without.var()))


def in_common(images: Image, weight: Image) -> float:
    """Variance of the windows' mean errors over that of the pixels' errors."""
    errors = torch.from_numpy((images - images.mean(0)) * np.sqrt(weight)).permute(0, 3, 1, 2)
    windows = torch.stack([box_mean(error, WINDOW) for error in errors])
    return float(windows.square().mean() / errors.square().mean())


def _file(place: Place, number: int, options: argparse.Namespace) -> Path:
    path: Path = options.out / place.name / f"{number:05}.npz"
    return path


def _saved(file: Path, arrays: dict[str, Image]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_name(f".{os.getpid()}.{file.name}")
    with temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)
    os.replace(temporary, file)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="ROUNDS")
    parser.add_argument("scenes", type=Path, nargs="*", metavar="SCENE.xml")
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--size", type=int, default=128, help="pixels of the piece (default: %(default)s)")
    parser.add_argument("--of", type=int, default=1024, help="pixels of the frame that it is cut out of")
    parser.add_argument("--spp", type=int, default=8, help="of each of the eight renders (default: %(default)s)")
    parser.add_argument("--symmetric", action="store_true", help="a further row, of noise without skew")
    return parser.parse_args()


if __name__ == "__main__":
    main()
