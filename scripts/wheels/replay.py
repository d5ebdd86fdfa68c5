"""Whether the kernels of a wheel give on this machine what record.py has kept on another; needs NumPy alone.

    python scripts/wheels/replay.py CALLS WHEEL

Also under an emulator. Every array that a call has written must be the recorded one, but for rounding; exit code 1
where one is not. What a convolution keeps for its gradients is handed on as it is: its layout is the kernel's own. The
models of a regression are compared by what they say at the pixels of their windows: slopes along features that are
combinations of others are nobody's but rounding's.
"""

import argparse
import importlib.util
import pickle
import platform
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

TOLERANCE = 2e-5  # of the largest value: sums are added up in another order


def kernels(wheel: Path, folder: Path) -> Any:
    """The extension module of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if "/_cpu." in name and not name.endswith(".pyi"))
        path = archive.extract(name, folder)
    spec = importlib.util.spec_from_file_location("_cpu", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def compare(module: Any, calls: list[Any]) -> dict[str, float]:
    """Largest difference of each function, relative to the largest value that it wrote."""
    worst: dict[str, float] = {}
    kept: Any = None
    for name, arguments, expected in calls:
        given = [argument.copy() if isinstance(argument, np.ndarray) else argument for argument in arguments]
        opaque = [
            i for i, argument in enumerate(given) if isinstance(argument, np.ndarray) and argument.dtype == np.uint8
        ]
        if name == "convolution_backward":
            for i in opaque:
                given[i] = kept
        getattr(module, name)(*given)
        for i, (one, before, other) in enumerate(zip(given, arguments, expected, strict=True)):
            if i in opaque:
                kept = one
            elif isinstance(one, np.ndarray) and not np.array_equal(before, other, equal_nan=True):
                got, wanted = (said(arguments, each) for each in (one, other)) if name == "solve" else (one, other)
                apart = np.abs(got.astype(float) - wanted).max() / max(np.abs(wanted).max(), 1e-30)
                worst[name] = max(worst.get(name, 0.0), float(apart))
    return worst


def said(arguments: list[Any], models: Any) -> Any:
    """Values of the models that ``solve`` wrote, (taps, 3, height, width)."""
    planes, vectors, scalars, radius, stride, margin, height, width = arguments[:8]
    features = 3 * vectors + scalars
    model = models.reshape(3, features + 1, height, width).astype(float)

    def cells(place: int, row: int, column: int) -> Any:
        top, left = margin + row, margin + column
        return planes[place, :features, top : top + height, left : left + width].astype(float)

    values = []
    for dy in range(-radius, radius + 1):
        for dx in range(-radius, radius + 1):
            (row, within_row), (column, within_column) = divmod(dy, stride), divmod(dx, stride)
            difference = cells(within_row * stride + within_column, row, column) - cells(0, 0, 0)
            values.append(model[:, 0] + (model[:, 1:] * difference).sum(1))
    return np.stack(values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("calls", metavar="CALLS", type=Path, help="file of record.py")
    parser.add_argument("wheel", metavar="WHEEL", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        worst = compare(kernels(options.wheel, Path(folder)), pickle.loads(options.calls.read_bytes()))
    for name, apart in worst.items():
        print(f"{name}: {apart:.1e}")
    bad = [name for name, apart in worst.items() if not apart <= TOLERANCE]
    print(f"{platform.machine()}, Python {platform.python_version()}: {len(worst)} functions, {len(bad)} differ {bad}")
    sys.exit(1 if bad or not worst else 0)


if __name__ == "__main__":
    main()
