"""Further denoised images: which are asked for, and that they end up in the output."""

import json
from pathlib import Path

import pytest
import torch
from helpers.commands import BALANCED
from torch import Tensor

import denoisers
from selfcorrect import Frame, cli
from selfcorrect.candidates import WORTH, promises, with_candidates

SIZE = (300, 280)


def blurred(side: int):
    """A denoiser that takes the mean over side×side pixels."""

    def denoise(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
        planes = torch.nn.functional.avg_pool2d(
            color.permute(2, 0, 1)[None], side, 1, side // 2, count_include_pad=False
        )
        return planes[0].permute(1, 2, 0)

    return denoise


def shifted(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    """By half a period: bright stripes where dark ones are."""
    return color.roll(6, 1)


def make_frame() -> tuple[Frame, Tensor]:
    """Fine stripes under little noise: the wide blur loses them, the narrow one does not."""
    x = torch.arange(SIZE[1])
    truth = (1 + 0.5 * torch.sin(x / 2))[None, :, None].expand(*SIZE, 3)
    generator = torch.Generator().manual_seed(0)
    color = tuple(truth + 0.2 * torch.randn(*SIZE, 3, generator=generator) for _ in "ab")
    return Frame(color=color).denoise(blurred(9)), truth


def test_what_is_better_is_asked_for_and_what_is_worse_is_not() -> None:
    frame, truth = make_frame()
    further = {"narrow": blurred(3), "wrong": shifted}
    found = promises(frame, further)
    assert found["narrow"] > 0.5
    assert found["wrong"] <= WORTH
    taken, told = with_candidates(frame, further, every=False)
    assert [candidate.name for candidate in taken.more] == ["narrow"]
    assert told == found
    before, after = (float(((image - truth) ** 2).mean()) for image in (frame.denoised_full, taken.more[0].full))
    assert after < 0.5 * before
    assert [c.name for c in with_candidates(frame, further, every=True)[0].more] == ["narrow", "wrong"]


@pytest.mark.parametrize(("which", "names"), [("all", ["oidn:fast", "oidn:none"]), ("none", [])])
def test_the_command_tells_which_were_taken(
    which: str, names: list[str], halves: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [*BALANCED, "--denoiser", "oidn", "--candidates", which, "--json"]
    assert cli.main(["frame", *map(str, halves), "-o", str(tmp_path / "out.exr"), *flags]) == 0
    out, err = capsys.readouterr()
    told = json.loads(out)["candidates"]
    assert list(told) == names
    assert all(entry["taken"] for entry in told.values())
    assert err.count("candidate oidn:") == len(names)


def test_a_denoiser_of_one_mode_has_no_others() -> None:
    assert denoisers.variants("box") == ()
    assert denoisers.variants("oidn:none") == ("oidn", "oidn:fast")
