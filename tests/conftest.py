"""What every test shares: the development frames, and fresh memory that is never zero by luck."""

import os
from pathlib import Path

import pytest
import torch

torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(mode=True)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the development frames, beside the checkout or where SELFCORRECT_SHARED says."""
    return shared_folder()


def shared_folder() -> Path:
    here = Path(__file__).resolve().parent.parent.parent / "shared"
    return Path(os.environ.get("SELFCORRECT_SHARED", here))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests that need the development frames where there are none."""
    if shared_folder().is_dir():
        return
    away = [item for item in items if item.get_closest_marker("shared")]
    config.hook.pytest_deselected(items=away)
    items[:] = [item for item in items if not item.get_closest_marker("shared")]
