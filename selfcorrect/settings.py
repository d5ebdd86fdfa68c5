"""One settings object. The command's flags are its fields; every default names its source."""

import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, NamedTuple, Self

from selfcorrect.errors import SettingsError

__all__ = ["ALL_LAYERS", "COMBINE_KERNELS", "EXTRA_FLAGS", "STAGE_NAMES", "ExtraFlag", "Settings", "seconds"]

_PAPER = "Back et al. 2022"
_OURS = "not in the paper; scripts/bench/quality.py measures it"
_WARM = "not in the paper; scripts/bench/shot.py measures it"
_TRAINED = "the package's own are trained by scripts/train"
_TRADE = "scripts/bench/tradeoff.py measures it"
_MOST = 2**31 - 1
"""Of whole numbers: what every counter below holds."""

_STAGES = "not in the paper; scripts/bench/stages.py measures it"


def _setting(
    default: Any,
    help_: str,
    source: str,
    *,
    choices: tuple[str, ...] = (),
    least: float = 0,
    unit: str = "",
    most: float | None = None,
) -> Any:
    """A field with what the command's flag and the range check need."""
    most = most or (_MOST if isinstance(default, int) else sys.float_info.max)
    metadata = {"help": help_, "source": source, "choices": choices, "least": least, "most": most, "unit": unit}
    return field(default=default, metadata=metadata)


_KINDS: dict[type, tuple[str, tuple[type, ...]]] = {
    str: ("a name", (str,)),
    int: ("a whole number", (int,)),
    float: ("a number", (int, float)),
    bool: ("true or false", (bool,)),
}


_SWITCHES = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


def seconds(text: str) -> float:
    """Seconds from 10, 10s, 2m or 1h.

    Raises:
        SettingsError: it is no time.
    """
    units = {"s": 1.0, "m": 60.0, "h": 3600.0}
    number, unit = (text[:-1], units[text[-1]]) if text[-1:] in units else (text, 1.0)
    try:
        return float(number) * unit
    except ValueError:
        raise SettingsError(f"expected a time like 10s or 2m, but got {text!r}") from None


def _check(name: str, value: object, kind: type, metadata: Mapping[str, Any]) -> None:
    expected, types = _KINDS[kind]
    if not isinstance(value, types) or (isinstance(value, bool) and kind is not bool):
        raise SettingsError(f"expected {expected} for the setting {name}, but got {value!r}")
    if kind is str and metadata["choices"] and value not in metadata["choices"]:
        raise SettingsError(f"expected {name} out of {', '.join(metadata['choices'])}, but got {value!r}")
    if isinstance(value, (int, float)) and not metadata["least"] <= value <= metadata["most"]:
        bound = f"at most {metadata['most']}" if value > metadata["most"] else f"at least {metadata['least']}"
        raise SettingsError(f"expected {name} of {bound}, but got {value!r}")


STAGE_NAMES = ("regression", "core", "james-stein", "neural-james-stein", "deep-combiner", "deep-combiner-4")


ALL_LAYERS = "all"
"""Instead of names of view layers: every one that both halves have."""

COMBINE_KERNELS = ("uncorrelated", "cross-weighting", "uniform")
"""Weights of the command ``combine``, the default first."""


class ExtraFlag(NamedTuple):
    """The flag by which the command ``frame`` takes images beyond the halves for a stage.

    Attributes:
        flag: its name.
        files: what help calls each.
        help: of the flag.
    """

    flag: str
    files: tuple[str, ...]
    help: str


EXTRA_FLAGS = {
    "deep-combiner-4": ExtraFlag(
        "--sub-images",
        ("A1.exr", "A2.exr", "B1.exr", "B2.exr"),
        "the two renders whose mean is half a, and those of half b, for the stage deep-combiner-4",
    )
}
"""By name of the stage; here, as help must not wait for what stages import."""


def _check_stages(stages: str) -> None:
    names = stages.split(",")
    unknown = [name for name in names if name not in STAGE_NAMES]
    if unknown or len(set(names)) < len(names):
        raise SettingsError(f"expected stages out of {','.join(STAGE_NAMES)}, each at most once, but got {stages!r}")


@dataclass(frozen=True)
class Settings:
    """Everything that decides the result, given the same input, machine and thread count.

    Raises:
        SettingsError: a value is out of range.
    """

    stages: str = _setting(
        "core", f"what runs, in this order, before the guard: out of {','.join(STAGE_NAMES)}", _STAGES
    )
    regression_stride: int = _setting(
        2, "the stage regression solves a model at every so many-th pixel of as many rows", _STAGES, least=1
    )
    james_stein_weights: str = _setting(
        "", "trained weights of the stage neural-james-stein; by default the package's", _TRAINED, unit="file"
    )
    combiner_weights: str = _setting(
        "", "trained weights of the stage deep-combiner; by default the package's", _TRAINED, unit="file"
    )
    combiner_4_weights: str = _setting(
        "", "trained weights of the stage deep-combiner-4; the package has none", _TRAINED, unit="file"
    )
    combination: str = _setting(
        "eq10", "what the window's pixels are combined to", f"{_PAPER}, Table 1", choices=("eq10", "eq3")
    )
    window: int = _setting(19, "side of the cross-bilateral window, odd, at most 31", f"{_PAPER}, Sec. 4", least=1)
    taps_every: int = _setting(1, "in training, take one in so many of the window's pixels", _OURS, least=1)
    filters: int = _setting(16, "filters of each hidden convolution", f"{_PAPER}, Sec. 4", least=1, most=4096)
    layers: int = _setting(
        9, "3x3 convolutions", f"{_PAPER}, Sec. 4; the other presets' five: {_TRADE}", least=2, most=256
    )
    precision: str = _setting(
        "fp32",
        "of the convolutions: fp32, or bf16 where the processor has products or matrix tiles of it",
        f"{_PAPER}, published code",
        choices=("fp32", "bf16"),
    )
    cuda_graph: bool = _setting(
        False,
        "record a training step on CUDA once and replay it: less work for the host; never tried on a GPU",
        "not in the paper; scripts/bench/gpu.py measures it where there is a GPU",
    )
    patch: int = _setting(128, "side of a training patch, pixels", f"{_PAPER}, Sec. 4", least=1, most=65536)
    stride: int = _setting(64, "distance of neighbouring patches, pixels", f"{_PAPER}, Sec. 4", least=1)
    batch: int = _setting(16, "patches in one optimiser step", f"{_PAPER}, Sec. 4", least=1, most=65536)
    epochs: int = _setting(20, "passes over all patches", f"{_PAPER}, Sec. 4", least=0)
    steps: int = _setting(0, "optimiser steps on patches drawn at random; 0 counts epochs", _OURS)
    visits: int = _setting(
        0,
        "how often steps may see a pixel on average: fewer steps on small frames; 0 sets no bound",
        "not in the paper; scripts/bench/small_frames.py measures it",
    )
    warm_steps: int = _setting(0, "steps of a frame that starts warm, at most those of any frame; 0 takes those", _WARM)
    learning_rate: float = _setting(0.01, "Adam's rate", f"{_PAPER}, published code")
    warm_learning_rate: float = _setting(0.0, "rate of a frame that starts warm; 0 takes that of any frame", _WARM)
    rate_from_variance: bool = _setting(
        True, "multiply the rate by the root of the halves' variance", f"{_PAPER}, published code"
    )
    schedule: str = _setting("constant", "of the rate over the steps", _OURS, choices=("constant", "cosine"))
    gradient_limit: float = _setting(0.0, "largest norm of the gradient; 0 sets none", _OURS)
    adam_epsilon: float = _setting(1e-7, "Adam's epsilon", f"{_PAPER}, published code")
    loss_epsilon: float = _setting(0.01, "added to the squared radiance in the loss", f"{_PAPER}, Eq. 8", least=1e-12)
    input_scale: float = _setting(
        1.0, "what radiance is multiplied by before all else; 0 brings the frame's mean near 1", _OURS
    )
    log_radiance: bool = _setting(False, "show the network ln(1 + radiance)", _OURS)
    initialisation: str = _setting(
        "glorot",
        "of the network: glorot, or residual, whose first output is the denoised image plus the local mean residual",
        _OURS,
        choices=("glorot", "residual"),
    )
    inference: str = _setting(
        "halves",
        "the result is the mean of the corrected halves, or full: that and what the denoiser gains from both together",
        f"{_PAPER}, Sec. 4",
        choices=("halves", "full"),
    )
    guard: bool = _setting(False, "blend with the denoised image as far as the halves confirm it", _OURS)
    fireflies: str = _setting(
        "keep",
        "that the denoiser has left in one half only: remove, within a hundredth of the light, or keep",
        "not in the paper; scripts/bench/fireflies.py measures it",
        choices=("remove", "keep"),
    )
    crossed_weights: bool = _setting(
        False, "weigh a half's loss by its own denoised image, not by its witness's", _OURS
    )
    witness_limit: float = _setting(
        0.0,
        "how many times the spread around it a witness's pixel may lie from its denoised image in the loss; 0: any",
        "not in the paper; scripts/bench/witness.py measures it",
    )
    candidates: str = _setting(
        "none",
        "further denoised images, of the denoiser's other modes, that the guard may blend in: none; auto, those that a "
        "few crops do not rule out; or all",
        "not in the paper; scripts/bench/quality.py measures it",
        choices=("none", "auto", "all"),
    )
    frame_radius: int = _setting(
        0,
        "of a shot: how many frames on either side give their samples to the candidate history; 0 takes none",
        _WARM,
    )
    time_budget: float = _setting(
        0.0,
        "seconds for the whole frame: training takes what the rest leaves; 0 sets none",
        "the user's",
        unit="s",
    )
    seed: int = _setting(
        0, "of the network's first weights and the order of the patches", "any number will do", most=2**63 - 1
    )

    def __post_init__(self) -> None:
        for f in fields(self):
            _check(f.name, getattr(self, f.name), type(f.default), f.metadata)
        _check_stages(self.stages)
        if self.regression_stride > 16:
            raise SettingsError(f"expected a regression_stride of at most 16, but got {self.regression_stride}")
        if self.window % 2 == 0 or self.window > 31:
            raise SettingsError(f"expected an odd window of at most 31, but got {self.window}")
        if not self.steps and self.stride > self.patch:
            raise SettingsError(f"expected a stride of at most the patch ({self.patch}), but got {self.stride}")

    @classmethod
    def parsed(cls, name: str, text: str) -> Any:
        """The value of one setting, as a person writes it.

        Raises:
            SettingsError: no such setting, or no such value.

        >>> Settings.parsed("window", "7"), Settings.parsed("guard", "off"), Settings.parsed("time_budget", "2m")
        (7, False, 120.0)
        """
        found = {f.name: f for f in fields(cls)}.get(name)
        if found is None:
            raise SettingsError(f"expected settings out of {', '.join(f.name for f in fields(cls))}, but got {name!r}")
        kind: type[Any] = type(found.default)
        if found.metadata["unit"] == "s":
            return seconds(text)
        try:
            return _SWITCHES[text.lower()] if kind is bool else kind(text)
        except (KeyError, ValueError):
            raise SettingsError(f"expected {_KINDS[kind][0]} for the setting {name}, but got {text!r}") from None

    @property
    def files(self) -> tuple[str, ...]:
        """The files that settings name."""
        return tuple(
            getattr(self, f.name) for f in fields(self) if f.metadata["unit"] == "file" and getattr(self, f.name)
        )

    @property
    def stage_names(self) -> tuple[str, ...]:
        """What runs, in order."""
        return tuple(self.stages.split(","))

    @classmethod
    def presets(cls) -> dict[str, Self]:
        """Every preset by its name; the first is the default.

        ``paper`` is Back et al. 2022 as published. The others are points of the trade of speed for accuracy that
        `scripts/bench/tradeoff.py` measures; `scripts/bench/RESULTS.md` has its table.
        """
        balanced = cls(
            patch=64,
            batch=4,
            steps=400,
            warm_steps=133,
            visits=64,
            learning_rate=1e-3,
            warm_learning_rate=5e-4,
            rate_from_variance=False,
            schedule="cosine",
            gradient_limit=1.0,
            input_scale=0.0,
            log_radiance=True,
            initialisation="residual",
            inference="full",
            guard=True,
            fireflies="remove",
            crossed_weights=True,
            witness_limit=8.0,
            precision="bf16",
            candidates="auto",
            frame_radius=2,
            layers=5,
        )
        return {
            "balanced": balanced,
            "fast": replace(
                balanced, steps=75, warm_steps=25, learning_rate=3.3e-3, warm_learning_rate=1.7e-3, candidates="none"
            ),
            "best": replace(balanced, batch=16, visits=128, candidates="all"),
            "paper": cls(),
        }

    @classmethod
    def default(cls) -> str:
        """Name of the default preset."""
        return next(iter(cls.presets()))

    @classmethod
    def preset(cls, name: str, **changes: Any) -> Self:
        """The preset of this name, with single fields changed.

        Raises:
            SettingsError: no such preset, or no such field.
        """
        presets = cls.presets()
        if name not in presets:
            raise SettingsError(f"expected a preset out of {', '.join(presets)}, but got {name!r}")
        return cls.from_dict(asdict(presets[name]) | changes)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Self:
        """Settings from saved values; unknown keys are errors."""
        unknown = sorted(set(values) - {f.name for f in fields(cls)})
        if unknown:
            known = ", ".join(f.name for f in fields(cls))
            raise SettingsError(f"expected settings out of {known}, but got {unknown[0]!r}")
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON and for the output's attributes."""
        return asdict(self)
