"""The facts of a run: what each reader is told is what is known, under the names that files and scripts rely on."""

import json
from dataclasses import asdict, replace
from importlib.metadata import version

from selfcorrect import Settings, facts
from selfcorrect.exr.passes import Others
from selfcorrect.fireflies import Removed
from selfcorrect.guard import Estimate
from selfcorrect.image.repair import Repairs
from selfcorrect.stages.stage import Start

ESTIMATE = Estimate(noisy=0.5, denoised=0.02, corrected=0.015, change=-0.25, standard_error=0.03, improved=True)
DENOISED = facts.Denoised(
    denoiser="box",
    channels={"color": ["R", "G", "B"], "depth": ["dd.T"]},
    size=(24, 30),
    repairs={"color": Repairs(3, 1), "depth": Repairs(0, 0)},
    constant=["albedo"],
    seconds={"read": 0.12345, "denoise": 0.5},
    promises={"oidn:none": 0.25, "oidn:fast": 0.0},
    candidates=("oidn:none",),
)
REMOVED = Removed(pixels=0.002, light=0.0015, error=0.25, standard_error=0.125)
CORRECTED = facts.Corrected(
    before=DENOISED,
    preset="fast",
    settings=Settings(seed=7),
    estimate=ESTIMATE,
    removed=REMOVED,
    lone=2,
    start=Start(warm=True, cold_loss=0.5, warm_loss=0.25),
    seconds={"train": 1.0, "infer": 0.25},
    input_scale=2.0,
    steps=17,
    parameters=20303,
    threads=2,
    place="mostly in the highlights",
    more={"frame": 3},
    shares={"history": 0.8, "stages": 0.2},
)
WRITTEN = facts.Written("out.exr", 4, Others(3, 2), {"write": 0.01, "total": 2.0}, CORRECTED)
RUN = {
    "preset": "fast",
    "denoiser": "box",
    "version": version("selfcorrect"),
    "estimate": asdict(ESTIMATE),
    "fireflies": {"pixels": 0.002, "light": 0.0015, "error": 0.25, "standard_error": 0.125},
    "lone_pixels": 2,
    "gained_by": {"history": 0.8, "stages": 0.2},
    "start": {"warm": True, "cold_loss": 0.5, "warm_loss": 0.25},
    "frame": 3,
}


def test_attributes() -> None:
    attributes = CORRECTED.attributes()
    assert set(attributes) == {"selfcorrect/settings", "selfcorrect/run"}
    assert json.loads(attributes["selfcorrect/settings"]) == Settings(seed=7).to_dict()
    assert list(json.loads(attributes["selfcorrect/run"]).items()) == list(RUN.items())


def test_json() -> None:
    told = json.loads(json.dumps(WRITTEN.to_dict()))
    assert list(told.items()) == [
        ("output", "out.exr"),
        ("settings", Settings(seed=7).to_dict()),
        *RUN.items(),
        ("channels", {"color": ["R", "G", "B"], "depth": ["dd.T"]}),
        ("other_channels", {"mean": 3, "kept": 2, "corrected": 0, "lacking": []}),
        ("seconds", {"read": 0.123, "denoise": 0.5, "train": 1.0, "infer": 0.25, "write": 0.01, "total": 2.0}),
        ("size", {"width": 30, "height": 24}),
        ("repairs", {"color": {"non_finite": 3, "negative": 1}, "depth": {"non_finite": 0, "negative": 0}}),
        ("constant", ["albedo"]),
        ("candidates", {"oidn:none": {"promise": 0.25, "taken": True}, "oidn:fast": {"promise": 0.0, "taken": False}}),
        ("history", None),
        ("input_scale", 2.0),
        ("steps", 17),
        ("parameters", 20303),
        ("threads", 2),
    ]


def test_log() -> None:
    assert facts.channel_lines(DENOISED.channels) == ["color: R, G, B", "depth: dd.T"]
    assert DENOISED.lines() == [
        "albedo: the same at every pixel; not used",
        "color: 3 pixels were NaN or infinite, 1 negative; repaired",
        "candidate oidn:none: taken, a few crops promise up to 25 % less error",
        "candidate oidn:fast: left out, a few crops promise up to 0 % less error",
    ]
    assert WRITTEN.lines() == [
        "fireflies of one half were removed from 0.20% of the pixels, with 0.15% of the light; --fireflies keep leaves "
        "them",
        "left as the denoiser has them: 2 pixels that both halves show over a hundred times as bright as all around, "
        "like stars or fireflies",
        "80 % of the gain are the neighbouring frames'",
        "out.exr: 4 values beyond the range of half floats were clipped",
        "other channels: 3 the mean of both halves, 2 as in half a",
        "out.exr: written after 2.0 s (train 1.0 s, infer 0.2 s)",
        "out.exr: error about 25 % lower, mostly in the highlights (relMSE ≈ 0.02 → 0.015, -25 ± 3 %)",
    ]
    unguarded = replace(
        WRITTEN, clipped=0, corrected=replace(CORRECTED, estimate=None, removed=None, lone=0, shares={})
    )
    assert unguarded.lines() == WRITTEN.lines()[4:6]
    assert unguarded.to_dict()["estimate"] is None


def closing(**changes: object) -> str:
    estimate = replace(ESTIMATE, **changes)
    return replace(WRITTEN, corrected=replace(CORRECTED, estimate=estimate, place="")).lines()[-1]


def test_the_last_words_are_for_artists() -> None:
    kept = "out.exr: kept the denoised image: the two halves do not agree that the correction is better"
    assert closing(improved=False) == f"{kept} (relMSE ≈ 0.02)"
    shared = closing(improved=False, independent=False)
    assert shared.startswith("out.exr: kept the denoised image: the two halves share their noise")
    assert "relMSE" not in shared
    assert closing(change=-0.001).startswith("out.exr: error less than 1 % lower (relMSE")


def test_what_a_frame_started_from() -> None:
    assert CORRECTED.start_line() == "started warm (loss before training 0.25 warm, 0.5 cold)"
    cut = replace(CORRECTED, start=Start(False, 0.5, 0.75))
    assert cut.start_line().startswith("did not look like the frame before: started cold (loss")
    assert replace(CORRECTED, start=Start(False)).start_line() == "started cold"
