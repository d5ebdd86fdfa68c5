"""Which form runs: by device and type, or as asked; what cannot be is named."""

import pytest
import torch

from selfcorrect.errors import SettingsError
from selfcorrect.kernel.backend import choose, instruction_set, instruction_sets

SINGLE, DOUBLE = torch.zeros(2), torch.zeros(2, dtype=torch.float64)
ELSEWHERE = torch.zeros(2, device="meta")


def test_the_compiled_form_where_it_can() -> None:
    assert choose(None, [SINGLE]) == "cpu"
    assert choose(None, [SINGLE, DOUBLE]) == "reference"
    assert choose(None, [SINGLE, DOUBLE], dtypes=(torch.float32, torch.float64)) == "cpu"
    assert choose(None, [SINGLE, ELSEWHERE]) == "reference"
    assert choose(None, [SINGLE], fits=False) == "reference"


def test_what_is_asked_for_is_taken() -> None:
    assert choose("reference", [SINGLE]) == "reference"
    assert choose("cpu", [SINGLE]) == "cpu"


def test_what_cannot_be_is_named() -> None:
    with pytest.raises(SettingsError, match="expected a backend out of cpu, reference, but got 'tpu'"):
        choose("tpu", [SINGLE])
    with pytest.raises(SettingsError, match="expected float32 on cpu for the backend cpu, but got float64 on cpu"):
        choose("cpu", [DOUBLE])
    with pytest.raises(SettingsError, match="but got float32 on meta; leave the backend to be chosen"):
        choose("cpu", [ELSEWHERE])
    with pytest.raises(SettingsError, match="expected float32 on cpu and few channels for the backend cpu"):
        choose("cpu", [SINGLE], fits=False, limit="few channels")


def test_instruction_sets() -> None:
    assert instruction_sets()[0] == "baseline"
    assert instruction_set("") == instruction_sets()[-1]
    assert instruction_set("baseline") == "baseline"
    assert instruction_set("", ["a", "b"]) == "b"
    with pytest.raises(SettingsError, match=r"expected an instruction set out of baseline.*, but got sse9"):
        instruction_set("sse9")
