"""Damaged files against the command: nothing may crash, hang, raise, or write what is not finite.

    python scripts/bench/fuzz.py                        # five minutes
    python scripts/bench/fuzz.py --seconds 3600 --mutants 5000 --seed 1

Mutant number N of a seed is always the same: `--only N` makes it again and keeps its files. A worker process calls
the command in process, under a limit of memory; a mutant that works for longer than its limit, or ends the worker, is
counted and the worker is started anew. Ctrl-C ends it with the table of what was tried so far. Exit code 1 where
anything was found.
"""

import argparse
import contextlib
import io
import json
import os
import resource
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR
import torch

from selfcorrect import cli
from selfcorrect.errors import SelfcorrectError
from selfcorrect.exr import header

HEIGHT, WIDTH = 20, 24
COMPRESSIONS = (
    "NO",
    "RLE",
    "ZIPS",
    "ZIP",
    "PIZ",
    "PXR24",
    "B44",
    "B44A",
    "DWAA",
    "DWAB",
    "HTJ2K256",
    "HTJ2K32",
    "ZSTD",
)
LAYOUTS = ("scan lines", "tiles", "two parts", "part per pass")
COMMANDS = ("inspect", "compare", "frame", "sequence")
SHARES = (0.72, 0.14, 0.10, 0.04)  # of the mutants, by what each command costs
MEMORY = 1536 * 2**20  # bytes beyond what the worker takes at its start
LIMIT = 60.0  # seconds of the processor for one mutant: on a busy machine a slow one is no hang
STUCK = 900.0  # seconds on the clock, for what waits and works no more
FAST = (
    "--steps 1 --warm-steps 1 --patch 8 --batch 1 --window 3 --network-layers 2 --filters 2 --denoiser box --threads 1"
)
ODD = (0, 1, 2, 3, 7, 255, 2**15, 2**16, 2**24, 2**31 - 1, -1, -2, -(2**31))
FLOATS = (0.0, -1.0, 1e-45, 1e-30, 65504.0, 1e30, 3e38, float("nan"), float("inf"), float("-inf"))
TYPES = (
    b"string int float double rational timecode keycode v2i v2f v2d v3f box2i box2f m33f m44f m44d "
    b"chromaticities envmap stringvector floatvector preview chlist compression lineOrder tiledesc bytes idmanifest "
    b"deepImageState vendor"
).split()
NAMES = (
    b"owner framesPerSecond chromaticities version name type view multiView chunkCount tiles lineOrder timeCode "
    b"selfcorrect/run pixelAspectRatio screenWindowWidth preview dwaCompressionLevel vendor"
).split()


class Found(NamedTuple):
    """What became of a mutant: its command, the kind of damage, the outcome, and what tells of a bad one."""

    command: str
    damage: str
    outcome: str
    detail: str = ""


GOOD = ("done", "refused")
"""Outcomes that are as they should be."""


def every_attribute() -> dict[str, Any]:
    """An attribute of every type that renderers write."""
    return {
        "owner": "a renderer",
        "framesPerSecond": Fraction(24000, 1001),
        "frame": 7,
        "exposure": 1.5,
        "corner": np.array([1, 2], np.int32),
        "point": np.array([1, 2], np.float32),
        "eye": np.array([1, 2, 3], np.float32),
        "worldToCamera": np.eye(4, dtype=np.float32),
        "layers": ["a", "b"],
        "region": (np.array([0, 0], np.int32), np.array([3, 3], np.int32)),
        "vendor": OpenEXR.OpaqueAttribute(b"anything", "vendor"),
    }


def whole(generator: np.random.Generator, compression: str, layout: str) -> bytes:
    """A good file; now and then its pixels hold extremes."""
    names = [*"RGBA", *(f"albedo.{c}" for c in "RGB"), *(f"nn.{c}" for c in "XYZ"), "dd.T"]
    kind = np.float16 if generator.random() < 0.5 else np.float32
    planes = {name: generator.random((HEIGHT, WIDTH), np.float32) for name in names}
    if generator.random() < 0.3:
        for _ in range(8):
            plane = planes[names[generator.integers(len(names))]]
            plane[generator.integers(HEIGHT), generator.integers(WIDTH)] = FLOATS[generator.integers(len(FLOATS))]
    with np.errstate(over="ignore"):
        pixels = {name: plane.astype(kind) for name, plane in planes.items()}
    own = {"compression": getattr(OpenEXR, f"{compression}_COMPRESSION"), "type": OpenEXR.scanlineimage}
    if layout == "tiles":
        own |= {"type": OpenEXR.tiledimage, "tiles": OpenEXR.TileDescription()}
    groups = [names]
    if layout == "two parts":
        groups = [names[:4], names[4:]]
    if layout == "part per pass":
        groups = [names[:4], names[4:7], names[7:10], names[10:]]
    parts = [
        OpenEXR.Part({**own, **(every_attribute() if not number else {})}, {n: pixels[n] for n in group}, f"p{number}")
        for number, group in enumerate(groups)
    ]
    stream = io.BytesIO()
    OpenEXR.File(parts).write(stream)
    return stream.getvalue()


def _attribute(generator: np.random.Generator, data: bytes) -> bytes:
    """Type, size or bytes of an attribute become others, or an odd attribute is put in."""
    headers, _ = header.parse(data, "")
    attributes = headers[generator.integers(len(headers))].attributes
    name, attribute = list(attributes.items())[generator.integers(len(attributes))]
    start, length = attribute.offset, len(attribute.data)
    before = start - 4 - len(attribute.type) - 1 - len(name.encode()) - 1
    new_type, new_name = TYPES[generator.integers(len(TYPES))], NAMES[generator.integers(len(NAMES))]
    body = generator.bytes(int(generator.integers(0, 40)))
    match generator.integers(5):
        case 0:  # bytes
            body = bytes(generator.bytes(length))
            return data[:start] + body + data[start + length :]
        case 1:  # size
            size = struct.pack("<i", ODD[generator.integers(len(ODD))])
            return data[: start - 4] + size + data[start:]
        case 2:  # type
            odd = name.encode() + b"\0" + new_type + b"\0" + struct.pack("<i", length)
            return data[:before] + odd + data[start:]
        case 3:  # gone
            return data[:before] + data[start + length :]
    odd = new_name + b"\0" + new_type + b"\0" + struct.pack("<i", len(body)) + body
    return data[:before] + odd + data[before:]


def _number(generator: np.random.Generator, data: bytes) -> bytes:
    """A number in the header becomes an odd one: windows, channel types, sampling, sizes of tiles."""
    _, tables = header.parse(data, "")
    place = int(generator.integers(8, tables - 4))
    return data[:place] + struct.pack("<i", ODD[generator.integers(len(ODD))]) + data[place + 4 :]


def _table(generator: np.random.Generator, data: bytes) -> bytes:
    """Offsets of chunks lead elsewhere."""
    _, tables = header.parse(data, "")
    damaged = bytearray(data)
    for _ in range(int(generator.integers(1, 4))):
        place = tables + 8 * int(generator.integers(2))
        damaged[place : place + 8] = struct.pack("<q", int(generator.integers(-9, 2 * len(data))))
    return bytes(damaged)


def _pixels(generator: np.random.Generator, data: bytes) -> bytes:
    """Bytes of chunks, their own headers among them."""
    _, tables = header.parse(data, "")
    damaged = bytearray(data)
    for place in generator.integers(tables, len(data), int(generator.integers(1, 12))):
        damaged[place] = int(generator.integers(256))
    return bytes(damaged)


def _bits(generator: np.random.Generator, data: bytes) -> bytes:
    """Any bits, anywhere but in the magic number."""
    damaged = bytearray(data)
    for place in generator.integers(4, len(data), int(generator.integers(1, 6))):
        damaged[place] ^= 1 << int(generator.integers(8))
    return bytes(damaged)


def _length(generator: np.random.Generator, data: bytes) -> bytes:
    """Cut, or longer than it should be."""
    if generator.random() < 0.2:
        return data + generator.bytes(100)
    return data[: int(generator.integers(len(data)))]


def _whole(_: np.random.Generator, data: bytes) -> bytes:
    """As it is: extremes of pixels only."""
    return data


DAMAGES: dict[str, Callable[[np.random.Generator, bytes], bytes]] = {
    "attribute": _attribute,
    "header number": _number,
    "chunk table": _table,
    "chunks": _pixels,
    "bits": _bits,
    "length": _length,
    "pixel values": _whole,
}


def mutant(seed: int, number: int, folder: Path) -> tuple[str, str, list[str]]:
    """Write the files of a mutant: its command, the kind of its damage, the arguments."""
    generator = np.random.default_rng([seed, number])
    compression, layout = COMPRESSIONS[number % len(COMPRESSIONS)], LAYOUTS[generator.integers(len(LAYOUTS))]
    command = str(generator.choice(COMMANDS, p=SHARES))
    damage = str(generator.choice(list(DAMAGES)))
    good = [whole(generator, compression, layout) for _ in range(2)]
    bad = list(good)
    for half in (0, 1) if generator.random() < 0.3 else (int(generator.integers(2)),):
        bad[half] = DAMAGES[damage](generator, good[half])
    if command == "inspect":
        bad.sort(key=lambda data: data in good)
    for name, data in zip(("a.0001.exr", "b.0001.exr"), bad, strict=True):
        (folder / name).write_bytes(data)
    if command == "sequence":
        for name, data in zip(("a.0002.exr", "b.0002.exr"), good, strict=True):
            (folder / name).write_bytes(data)
    a, b, out = str(folder / "a.0001.exr"), str(folder / "b.0001.exr"), str(folder / "out.0001.exr")
    if command == "sequence":
        a, b, out = (path.replace("0001", "####") for path in (a, b, out))
    given = {
        "inspect": [a],
        "compare": [a, b],
        "frame": [a, b, "-o", out, *FAST.split()],
        "sequence": [a, b, "-o", out, "--frames", "1-2", *FAST.split()],
    }
    return command, damage, [command, *given[command]]


def judged(command: str, code: int, out: str, err: str, folder: Path) -> tuple[str, str]:
    """The outcome of a run that came to its end, and what tells of a bad one."""
    errors = [line for line in err.splitlines() if line.startswith("selfcorrect: error: ")]
    written = [path for path in folder.iterdir() if path.name.startswith("out.")]
    if any(path.name.endswith("selfcorrect-tmp") for path in folder.iterdir()):
        return "left behind", "a temporary file"
    for path in written:
        pixels = [plane for part in OpenEXR.File(str(path), separate_channels=True).parts for plane in _radiance(part)]
        if not pixels or not all(np.isfinite(plane).all() for plane in pixels):
            return "not finite", path.name
    if code == 2:
        fine = len(errors) == 1 and not out and not written and "expected" in errors[0]
        return ("refused", "") if fine else ("badly refused", err[-300:])
    if command == "sequence" and code in (0, 1):  # the second frame is whole, whatever the first one is
        failed = "frame 1: failed: " in err
        fine = (folder / "out.0002.exr").exists() and failed == (code == 1) != (folder / "out.0001.exr").exists()
        return ("refused" if failed else "done", "") if fine else ("odd frame ended the shot", err[-300:])
    if code:
        return "another exit code", f"{code}: {err[-300:]}"
    fine = not errors and (bool(written) if command == "frame" else bool(out))
    return ("done", "") if fine else ("nothing done", err[-300:])


def _radiance(part: Any) -> list[Any]:
    return [channel.pixels for name, channel in part.channels.items() if name in {"R", "G", "B"}]


def one(seed: int, number: int, folder: Path) -> Found:
    """Make a mutant and run the command over it, in this process."""
    command, damage, arguments = mutant(seed, number, folder)
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = cli.main(arguments)
        outcome = judged(command, code, out.getvalue(), err.getvalue(), folder)
    except (Exception, SystemExit) as error:
        kind = "escaped" if isinstance(error, SelfcorrectError) else "traceback"
        outcome = kind, f"{type(error).__name__}: {error}"
    return Found(command, damage, *outcome)


def work(seed: int, first: int) -> None:
    """The worker: mutants from a number on, one line each, until it is ended."""
    torch.set_num_threads(1)
    told = os.fdopen(os.dup(1), "w")
    taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    number = first
    while True:
        with tempfile.TemporaryDirectory() as folder:
            found = one(seed, number, Path(folder))
        print(json.dumps(found), file=told, flush=True)
        number += 1


@contextlib.contextmanager
def worker(seed: int, first: int) -> Iterator["subprocess.Popen[bytes]"]:
    """A worker with a folder for its temporary files, both gone afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, __file__, "--seed", str(seed), "--work", str(first)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"TMPDIR": folder},
        )
        try:
            yield process
        finally:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()


def answered(process: "subprocess.Popen[bytes]") -> bool:
    """Whether the worker has something to say, be it that it is gone, within the limits from now on."""
    worked, start = spent(process.pid), time.monotonic()
    while time.monotonic() - start < STUCK and spent(process.pid) - worked < LIMIT:
        if select.select([process.stdout], [], [], 0.5)[0]:
            return True
    return False


def spent(process: int) -> float:
    """Seconds of the processor that a process has taken."""
    fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def mutants(seed: int, seconds: float, most: int, first: int = 0) -> Iterator[tuple[int, Found]]:
    """Number and fate of so many mutants from a first one on, or until the time is up, counted from its fate."""
    end, number = float("inf"), first
    while number < first + most and time.monotonic() < end:
        with worker(seed, number) as process:
            assert process.stdout is not None
            while number < first + most and time.monotonic() < end:
                ready = answered(process)
                line = process.stdout.readline() if ready else b""
                command, damage = ("", "") if line else _kind(seed, number)
                if line:
                    found = Found(*json.loads(line))
                elif ready:
                    found = Found(command, damage, "crash", f"signal {-process.wait()}")
                else:
                    found = Found(command, damage, "hang", f"longer than {LIMIT:.0f} s")
                end = min(end, time.monotonic() + seconds)
                yield number, found
                number += 1
                if not line:
                    break


def _kind(seed: int, number: int) -> tuple[str, str]:
    with tempfile.TemporaryDirectory() as folder:
        return mutant(seed, number, Path(folder))[:2]


def table(found: list[Found]) -> str:
    """Counts by damage and by command."""
    outcomes = [*GOOD, *sorted({f.outcome for f in found} - set(GOOD))]
    lines = [f"| | {' | '.join(outcomes)} |", "|---" * (len(outcomes) + 1) + "|"]
    for index, names in ((1, DAMAGES), (0, COMMANDS)):
        for name in names:
            counts = Counter(f.outcome for f in found if f[index] == name)
            lines.append(f"| {name} | {' | '.join(str(counts[outcome]) for outcome in outcomes)} |")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--mutants", type=int, default=10**9, help="most of them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, metavar="N", help="go on from this one")
    parser.add_argument("--only", type=int, metavar="N", help="this one, in this process; its files stay")
    parser.add_argument("--work", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work is not None:
        work(options.seed, options.work)
    if options.only is not None:
        shutil.rmtree(folder := Path(f"mutant-{options.only}"), ignore_errors=True)
        folder.mkdir()
        print(*one(options.seed, options.only, folder), sep="\n")
        return 0
    every = []
    with contextlib.suppress(KeyboardInterrupt):
        for number, found in mutants(options.seed, options.seconds, options.mutants, options.first):
            every.append(found)
            if found.outcome not in GOOD:
                print(f"{number}: {found}", flush=True)
    bad = sum(found.outcome not in GOOD for found in every)
    print(table(every), f"{len(every)} mutants of seed {options.seed} from {options.first} on, {bad} bad", sep="\n")
    return int(bad > 0 or not every)


if __name__ == "__main__":
    sys.exit(main())
