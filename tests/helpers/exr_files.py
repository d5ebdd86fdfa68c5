"""EXR files as renderers write them, and what holds of a file that was rewritten."""

import struct
from pathlib import Path

import numpy as np
import OpenEXR

from selfcorrect import exr
from selfcorrect.exr import header as exrheader

HEIGHT, WIDTH = 9, 14
SIZE = (HEIGHT, WIDTH)


def pixels(seed, dtype=np.float16, size=SIZE):
    rng = np.random.default_rng(seed)
    if dtype == np.uint32:
        return rng.integers(0, 2**32, size, dtype=np.uint32)
    return rng.normal(1.0, 2.0, size).astype(dtype)


def three(name, letters="RGB"):
    return [f"{name}.{letter}" for letter in letters]


def arrays(names, dtype=np.float16, start=0):
    return {name: pixels(start + number, dtype) for number, name in enumerate(names)}


def window(x, y, height=HEIGHT, width=WIDTH):
    return (np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32))


def save(path, *parts, **header):
    """Write parts, each (name, {channel: array}, {attribute: value}) or just a dict of channels."""
    full = [part if isinstance(part, tuple) else ("", part, {}) for part in parts]
    OpenEXR.File([OpenEXR.Part({**header, **own}, dict(channels), name) for name, channels, own in full]).write(
        str(path)
    )
    return path


def raw(attributes=(), channels=("B", "G", "R"), window=(0, 0, WIDTH - 1, HEIGHT - 1)):
    """Bytes of an uncompressed half EXR of one part; every pixel holds its channel's place in the list.

    The library writes neither every attribute nor a channel list out of order, so this does. The pixels of a
    scan line are in alphabetical order of the channels all the same, as the format has it.
    """
    listed = b"".join(name.encode() + b"\0" + struct.pack("<iB3xii", 1, 0, 1, 1) for name in channels)
    standard = {
        "channels": ("chlist", listed + b"\0"),
        "compression": ("compression", b"\0"),
        "dataWindow": ("box2i", struct.pack("<4i", *window)),
        "displayWindow": ("box2i", struct.pack("<4i", *window)),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1)),
        "screenWindowCenter": ("v2f", bytes(8)),
        "screenWindowWidth": ("float", struct.pack("<f", 1)),
    }
    long_names = 0x400 if any(len(name) > 31 for name, _, _ in attributes) else 0
    data = struct.pack("<II", 20000630, 2 | long_names)
    every = standard | {name: (kind, value) for name, kind, value in attributes}
    for name, (kind, value) in every.items():
        data += name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value
    data += b"\0"
    row = b"".join(np.full(WIDTH, channels.index(name), "<f2").tobytes() for name in sorted(channels))
    chunks = [struct.pack("<ii", y, len(row)) + row for y in range(window[1], window[1] + HEIGHT)]
    first = len(data) + 8 * HEIGHT
    data += b"".join(struct.pack("<Q", first + number * len(chunks[0])) for number in range(HEIGHT))
    return data + b"".join(chunks)


def attributes_of(path):
    headers, _ = exrheader.parse(Path(path).read_bytes(), str(path))
    return [{name: (a.type, a.data) for name, a in header.attributes.items()} for header in headers]


def same_bits(first, second):
    return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()


MITSUBA = [*"RGB", *three("albedo"), *three("nn", "XYZ"), "dd.T"]
CYCLES = [
    *three("ViewLayer.Combined", "RGBA"),
    *three("ViewLayer.Denoising Albedo"),
    *three("ViewLayer.Denoising Normal", "XYZ"),
    "ViewLayer.Denoising Depth.Z",
]


def blender_5(path, *layers, dtype=np.float32):
    """One part per pass, part and channels both with layer and pass in front, as Blender 5 writes them."""
    channels = arrays([name.replace("ViewLayer", layer) for layer in layers for name in CYCLES], dtype)
    passes = dict.fromkeys(name.rpartition(".")[0] for name in channels)
    parts = [(p, {n: a for n, a in channels.items() if n.rpartition(".")[0] == p}, {}) for p in passes]
    return save(path, *parts), channels


def assert_passed_through(source, target, *, but=(), added=()):
    """Every channel, type, window and attribute is the same to the bit, but those named."""
    before, after = exr.read(source), exr.read(target)
    assert len(before.parts) == len(after.parts)
    assert set(before.channel_names) | set(added) == set(after.channel_names)
    for name in before.channel_names:
        if name in but:
            assert before.pixels(name).dtype == after.pixels(name).dtype
        else:
            assert same_bits(before.pixels(name), after.pixels(name)), name
    for first, second in zip(attributes_of(source), attributes_of(target), strict=True):
        ours = {name for name in second if name.startswith("selfcorrect/")}
        assert {k: v for k, v in second.items() if k not in {*ours, "channels", "type", *but}} == {
            k: v for k, v in first.items() if k not in {"channels", "type", *but}
        }
        if not added:
            assert sorted_channels(second) == sorted_channels(first)


def sorted_channels(attributes):
    """The channel list in the order that the format asks for, with every field of each channel."""
    data, found = attributes["channels"][1], []
    while data[0]:
        end = data.index(b"\0") + 17
        found.append(data[:end])
        data = data[end:]
    return sorted(found)


def rewrite(source, target, names=("R", "G", "B"), **more):
    file = exr.read(source)
    color = np.stack([pixels(90 + number, np.float32, file.pixels(names[0]).shape) for number in range(3)], -1)
    clipped = exr.write(target, file, color, names, {"selfcorrect/seed": "7"}, **more)
    after = exr.read(target)
    for number, name in enumerate(names):
        expected = color[..., number].astype(file.pixels(name).dtype)
        assert same_bits(after.pixels(name), expected)
    return clipped
