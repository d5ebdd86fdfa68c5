"""The trained stages through the command: all at once, what it refuses, weights in the recipe and in help."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.trained import settings, write_render

import denoisers
from selfcorrect import Frame, cli, correct, exr
from selfcorrect.files import Sources
from selfcorrect.shot.recipe import recipe
from selfcorrect.stages.deep_combiner_4 import SubImages


def test_the_command(
    renders: list[str], weight_files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With OIDN, on all stages at once; the written image is that of the API."""
    output = str(tmp_path / "out.exr")
    flags = [part for name, file in weight_files.items() for part in (f"--{name.replace('_', '-')}", file)]
    stages = "deep-combiner-4,neural-james-stein"
    command = [
        "frame",
        *renders[:2],
        "--sub-images",
        *renders[2:],
        "-o",
        output,
        "--denoiser",
        "oidn",
        "--threads",
        "1",
    ]
    chosen = [*flags, "--stages", stages, "--no-guard", "--precision", "fp32"]
    threads = torch.get_num_threads()
    try:
        assert cli.main([*command, *chosen, "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        loaded = [exr.load_half(path).buffers for path in renders]
        pairs = {name: tuple(half[name] for half in loaded[:2]) for name in ("color", "albedo", "normal", "depth")}
        oidn = denoisers.create("oidn", threads=1)
        frame = Frame(**pairs).denoise(oidn)
        subs = SubImages.of(frame, [half["color"] for half in loaded[2:]]).denoise(frame, oidn)
        extra = {"deep-combiner-4": subs}
        expected = correct(frame, settings(weight_files, stages=stages), extra=extra).image
    finally:
        torch.set_num_threads(threads)
    assert report["settings"]["combiner_4_weights"] == weight_files["combiner_4_weights"]
    assert {"deep-combiner-4", "neural-james-stein"} <= report["seconds"].keys()
    assert report["repairs"]["sub_images"] == {"non_finite": 0, "negative": 0}
    np.testing.assert_allclose(exr.load_half(output).buffers["color"], expected, rtol=2e-3, atol=1e-4)


def test_the_command_refuses(
    renders: list[str], weight_files: dict[str, str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """In one line each, before any work, and the output that was there stays."""
    output = tmp_path / "out.exr"
    output.write_bytes(b"before")
    flags = [part for name, file in weight_files.items() for part in (f"--{name.replace('_', '-')}", file)]
    frame = ["frame", *renders[:2], "-o", str(output), "--denoiser", "box", *flags]
    four, subs = ["--stages", "deep-combiner-4"], ["--sub-images", *renders[2:]]
    small = write_render(tmp_path / "small.exr", [np.zeros((5, 5, 3))])
    given = ["frame", *renders[:2], "-o", str(output), *flags, "--denoised-a", renders[0], "--denoised-b", renders[1]]
    for command, line in (
        ([*frame, *four], "expected --sub-images"),
        ([*frame, *subs], "expected the stage deep-combiner-4"),
        ([*frame, *four, "--sub-images", *renders[2:5]], "--sub-images"),
        ([*frame, *four, "--sub-images", *renders[2:5], renders[2]], "the same file twice"),
        ([*frame, *four, "--sub-images", *renders[2:5], small], "expected 70x64 pixels"),
        ([*frame, *four, "--sub-images", renders[2], *renders[4:1:-1][:2], renders[5]], "mean is half a"),
        ([*frame, *four, "--sub-images", *renders[2:5], str(tmp_path / "none.exr")], "none.exr"),
        ([*given, *four, *subs], "expected --denoiser NAME"),
        ([*frame, "--stages", "core,deep-combiner-4", *subs], "as the first stage"),
        ([*frame, "--stages", "neural-james-stein", "--james-stein-weights", renders[0]], "intact trained weights"),
        ([*frame, "--stages", "deep-combiner", "--combiner-weights", "nowhere"], "nowhere: expected the weights"),
    ):
        assert cli.main(command) == 2, line
        told = capsys.readouterr()
        errors = [told_line for told_line in told.err.splitlines() if "error:" in told_line]
        assert len(errors) == 1
        assert line in errors[0]
        assert told.out == ""
        assert output.read_bytes() == b"before"


def test_other_weights_are_another_recipe(renders: list[str], weight_files: dict[str, str], tmp_path: Path) -> None:
    """A shot's frame that was made with other weights under the same name is not left out."""
    own = tmp_path / "own.safetensors"
    recipes = []
    for name in ("combiner_weights", "combiner_4_weights"):
        own.write_bytes(Path(weight_files[name]).read_bytes())
        chosen = settings({}, combiner_weights=str(own))
        recipes.append(recipe(Sources(*renders[:2]), chosen, {}))
    assert recipes[0] != recipes[1]


def test_help_names_the_weights(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["frame", "--help-all"])
    assert ended.value.code == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "--sub-images A1.exr A2.exr B1.exr B2.exr" in told
    assert "--james-stein-weights FILE trained weights of the stage neural-james-stein" in told
    assert "--combiner-4-weights FILE" in told
