"""The cross-bilateral kernel on ARM's vectors (NEON), under an emulator, against the float64 reference.

    .venv/bin/python scripts/bench/neon.py [--compiler aarch64-linux-gnu-g++] [--emulator qemu-aarch64]
        [--native]

Needs Debian's packages g++-aarch64-linux-gnu and qemu-user. The kernel's source is compiled as the build compiles it
and linked to neon.cpp, no Python and no torch: cases go in by a pipe, values and gradients come out. Cases are like
those of tests/kernel/test_cross_bilateral.py: every set of buffers, Eq. 10 and Eq. 3, lattices, and sizes around a
vector's length. Exit code 1 where one is further from the reference than the tests allow. --native does the same with
this machine's compiler and no emulator. An emulator says what is computed, not how fast.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from selfcorrect.buffers import TERMS, Buffer
from selfcorrect.kernel.cross_bilateral import Window, heads_count, reference
from selfcorrect.kernel.guides import Guides

SOURCE = Path(__file__).resolve().parent.parent.parent / "selfcorrect"
FLAGS = ("-std=c++17", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi", "-static")
VALUES, GRADIENTS = 1e-5, 5e-5  # of the largest, as in the tests


class Case(NamedTuple):
    """One call of the kernel."""

    guides: Guides
    raw: Tensor
    corners: Tensor
    window: Window
    target: Tensor
    weight: Tensor


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--compiler", default="aarch64-linux-gnu-g++")
    parser.add_argument("--emulator", default="qemu-aarch64")
    parser.add_argument("--native", action="store_true", help="this machine's compiler, no emulator")
    options = parser.parse_args()
    compiler, emulator = ("g++", []) if options.native else (options.compiler, [options.emulator])
    for program in (compiler, *emulator):
        if shutil.which(program) is None:
            sys.exit(f"expected the program {program}, but got none; see --help for its package")
    found = list(cases())
    with tempfile.TemporaryDirectory() as folder:
        program = build(compiler, Path(folder))
        ran = subprocess.run([*emulator, str(program)], input=packed(found), stdout=subprocess.PIPE, check=True)
    values, gradients = compared(found, np.frombuffer(ran.stdout, np.float32))
    print(f"{len(found)} cases: values off by {values:.1e} of the largest, gradients by {gradients:.1e}")
    sys.exit(int(values > VALUES or gradients > GRADIENTS))


def build(compiler: str, folder: Path) -> Path:
    """The program that runs the kernel."""
    kernel = SOURCE / "kernel" / "cross_bilateral"
    rows = subprocess.run(
        [sys.executable, str(kernel / "rows.py"), str(SOURCE / "buffers.py")], stdout=subprocess.PIPE, check=True
    )
    (folder / "term_rows.h").write_bytes(rows.stdout)
    program = folder / "neon"
    sources = [str(Path(__file__).with_name("neon.cpp")), str(kernel / "cross_bilateral.cpp")]
    includes = [f"-I{folder}", f"-I{kernel}", f"-I{kernel.parent}"]
    subprocess.run(
        [compiler, *FLAGS, "-DSELFCORRECT_ROW=row_baseline", *includes, "-o", str(program), *sources], check=True
    )
    return program


def cases() -> Iterator[Case]:
    optional = TERMS[2:]
    sets = [
        TERMS[:2] + tuple(t for t, there in zip(optional, kept, strict=True) if there)
        for kept in product((0, 1), repeat=len(optional))
    ]
    for terms in sets:
        for combination in ("eq10", "eq3"):
            yield case((23, 37), (13, 19), [(0, 0), (-5, 10), (12, 20)], Window(7, combination=combination), terms)
    for every in (2, 3, 4, 5):
        yield case((20, 19), (16, 18), [(3, 0), (-2, 1)], Window(9, every), TERMS)
    for side in (1, 3, 19, 31):
        for size in ((1, 1), (1, 17), (16, 1), (5, 7), (33, 15)):
            yield case(size, size, [(0, 0)], Window(side), TERMS)


def case(
    size: tuple[int, int],
    patch: tuple[int, int],
    corners: list[tuple[int, int]],
    window: Window,
    terms: tuple[Buffer, ...],
) -> Case:
    """One of random buffers; ``size`` is that of the image."""
    generator = torch.Generator().manual_seed(sum(size) + window.side)
    half = {term.name: torch.rand(*size, term.channels, generator=generator) for term in terms}
    guides = Guides.of_half(half, margin=window.radius + 8)
    raw = torch.randn(len(corners), heads_count(guides, window.combination), *patch, generator=generator)
    target = guides.radiance.flip(1).contiguous()
    return Case(guides, raw, torch.tensor(corners), window, target, guides.denoised.mean(0).contiguous() + 0.1)


def packed(found: list[Case]) -> bytes:
    parts = [np.array([len(found)], np.int64)]
    for c in found:
        planes = c.guides.planes.contiguous()
        present = sum(1 << TERMS.index(term) for term in c.guides.terms)
        n, heads, height, width = c.raw.shape
        eq3 = c.window.combination == "eq3"
        numbers = [present, eq3, c.window.side, c.window.every, n, height, width, heads, *planes.shape]
        parts += [np.array(numbers, np.int64), (c.corners + c.guides.margin).numpy()]
        parts += [image.numpy() for image in (planes, c.raw, c.target, c.weight)]
    return b"".join(part.tobytes() for part in parts)


def compared(found: list[Case], got: np.ndarray) -> tuple[float, float]:
    """The largest differences from the reference: of values, and of gradients of Eq. 8."""
    at, values, gradients = 0, 0.0, 0.0
    for c in found:
        raw = c.raw.double().requires_grad_()
        guides = Guides(c.guides.planes.double(), c.guides.height, c.guides.width, c.guides.margin, c.guides.terms)
        g = reference.cross_bilateral(guides, raw, c.corners, c.window)
        size = (raw.shape[2], raw.shape[3])
        places = [(slice(y, y + size[0]), slice(x, x + size[1])) for y, x in (c.corners + c.guides.margin).tolist()]
        target = torch.stack([c.target[:, rows, columns] for rows, columns in places])
        weight = torch.stack([c.weight[rows, columns] for rows, columns in places])[:, None]
        (0.5 * weight * (g - target) ** 2).sum().backward()
        assert raw.grad is not None
        for expected, is_value in ((g.detach(), True), (raw.grad, False)):
            part = torch.from_numpy(got[at : at + expected.numel()].copy()).view(expected.shape)
            at += expected.numel()
            apart = float((part - expected).abs().max() / expected.abs().max().clamp(min=1e-9))
            values, gradients = (max(values, apart), gradients) if is_value else (values, max(gradients, apart))
    assert at == len(got)
    return values, gradients


if __name__ == "__main__":
    main()
