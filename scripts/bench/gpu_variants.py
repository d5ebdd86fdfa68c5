"""What the kernel for CUDA compiles to, ahead of time: every variant's registers, spills, memory and inner loop.

`gpu.py` prints it, and predicts times from it; no device is needed.
"""

import re
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, combinations, product
from pathlib import Path

import triton
from kernel import make_guides
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource

from selfcorrect.kernel.cross_bilateral import Window, gpu, program

_OPTIONAL = {"ρ": "albedo", "n": "normal", "v": "visibility"}
BUFFERS = {
    " ".join(("y z", *some)): ("color", "denoised", *(_OPTIONAL[symbol] for symbol in some))
    for some in chain.from_iterable(combinations(_OPTIONAL, count) for count in range(len(_OPTIONAL) + 1))
}
"""What a frame may have, by symbols of Eq. 10: each buffer that need not be there, there and absent."""

EVERYTHING = "y z ρ n v"
_OTHERS = ((19, 1, "eq3"), (19, 4, "eq10"), (1, 1, "eq10"), (7, 1, "eq10"), (31, 1, "eq10"))
LARGEST_SHARED = 48 << 10  # bytes of a program, on every card and without asking for more

UNUSED = {"FORWARD": ("gradient", "target", "weight"), "BACKWARD": ("target", "weight"), "LOSS": ("image",)}
"""Modes of the kernel, and which pointers they are not given."""

TARGETS = (80, 90, 120)


@dataclass(frozen=True)
class Variant:
    """One specialisation of the device function, and what it was compiled to.

    Attributes:
        target: compute capability.
        mode, buffers, window, every, combination: the specialisation.
        registers: of a thread.
        spilled: bytes of a thread's registers that lie in memory.
        shared: bytes of a program.
        instructions: of the innermost loop, which is one tap.
        multiply_adds, loads: among those.
    """

    target: int
    mode: str
    buffers: str
    window: int
    every: int
    combination: str
    registers: int
    spilled: int
    shared: int
    instructions: int
    multiply_adds: int
    loads: int


def compiled(target: int, mode: str, buffers: str, window: int, every: int, combination: str) -> Variant:
    """Compile one variant ahead of time."""
    window_ = Window(window, every, combination)
    options = {"num_warps": gpu.WARPS, "enable_fp_fusion": True}
    result = triton.compile(source(mode, buffers, window_), target=GPUTarget("cuda", target, 32), options=options)
    usage, code = dumped(result.asm["cubin"])
    loop = innermost_loop(code)
    return Variant(
        target=target,
        mode=mode,
        buffers=buffers,
        window=window,
        every=every,
        combination=combination,
        registers=usage["REG"],
        spilled=usage["STACK"] + usage["LOCAL"] + 4 * sum(name in ("LDL", "STL") for _, name, _ in code),
        shared=max(usage["SHARED"], result.metadata.shared),
        instructions=len(loop),
        multiply_adds=loop.count("FFMA"),
        loads=loop.count("LDG"),
    )


def source(mode: str, buffers: str, window: Window) -> ASTSource:
    """The device function with the types that a launch gives it; torch aligns tensors to 16 bytes and more."""
    constants = gpu.specialisation(gpu.terms_of(make_guides(8, BUFFERS[buffers])), window, gpu.TILE)
    constants["MODE"] = getattr(program, mode).value
    constants |= dict.fromkeys(UNUSED[mode])
    pointers = {"corners": "*i64"} | dict.fromkeys(
        ("planes", "raw", "image", "gradient", "target", "weight", "losses"), "*fp32"
    )
    names = program.program.arg_names
    types = {name: "constexpr" if name in constants else pointers.get(name, "i32") for name in names}
    aligned = {(i,): [["tt.divisibility", 16]] for i, name in enumerate(names) if types[name].startswith("*")}
    return ASTSource(program.program, signature=types, constexprs=constants, attrs=aligned)


Code = list[tuple[int, str, str]]
"""Address, name and operands of each instruction."""


def dumped(cubin: bytes) -> tuple[dict[str, int], Code]:
    """What cuobjdump, which comes with Triton, tells of a compiled program."""
    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        texts = [
            subprocess.run([tool, flag, file.name], capture_output=True, text=True, check=True).stdout
            for flag in ("--dump-resource-usage", "-sass")
        ]
    usage = {name: int(value) for name, value in re.findall(r"([A-Z]+):(\d+)", texts[0])}
    line = re.compile(r"/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\w+\s+)?([A-Z0-9_]+)[^\s;]*\s*([^;]*);")
    return usage, [(int(address, 16), name, operands) for address, name, operands in line.findall(texts[1])]


def innermost_loop(code: Code) -> list[str]:
    """Instructions of the loop that has no other in it and evaluates an exponential; where there is one tap, none."""
    loops = []
    for address, name, operands in code:
        target = re.search(r"0x([0-9a-f]+)", operands)
        if name == "BRA" and target and int(target[1], 16) < address:
            body = [other for at, other, _ in code if int(target[1], 16) <= at <= address]
            if "MUFU" in body:
                loops.append(body)
    return min(loops, key=len, default=[])


def variants(*, few: bool) -> Iterator[Variant]:
    """Every mode and set of buffers as the presets have them, and with all buffers what else is specialised by.

    With ``few`` forward and loss as in the presets. Triton keeps what it has compiled: a run that was ended goes on
    where it was.
    """
    modes = ("FORWARD", "LOSS") if few else UNUSED
    usual = product(TARGETS, modes, [EVERYTHING] if few else BUFFERS, [(19, 1, "eq10")])
    others = product(TARGETS, () if few else UNUSED, [EVERYTHING], _OTHERS)
    for target, mode, buffers, options in chain(usual, others):
        yield compiled(target, mode, buffers, *options)


def unfit(table: list[Variant]) -> list[Variant]:
    """Those that spill, or take more shared memory than every card has."""
    return [variant for variant in table if variant.spilled or variant.shared > LARGEST_SHARED]


def programs_together(variant: Variant) -> int:
    """How many of them a multiprocessor's 65,536 registers hold; a warp's are given out by 256."""
    warp = -(-variant.registers * 32 // 256) * 256
    return 65536 // (warp * gpu.WARPS)
