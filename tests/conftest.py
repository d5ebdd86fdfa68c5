"""What every test shares: the development frames, and fresh memory that is never zero by luck."""

import os
from pathlib import Path

import pytest
import torch

torch.utils.deterministic.fill_uninitialized_memory = True
torch.use_deterministic_algorithms(mode=True)


def shared_folder() -> Path:
    here = Path(__file__).resolve().parent.parent.parent / "shared"
    return Path(os.environ.get("SELFCORRECT_SHARED", here))


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the development frames, beside the checkout or where SELFCORRECT_SHARED says."""
    return shared_folder()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests that need the development frames where there are none, and nowhere else."""
    needing = [item for item in items if item.get_closest_marker("shared")]
    if shared_folder().is_dir():
        if os.environ.get("SELFCORRECT_REQUIRE_SHARED") and not needing:
            raise pytest.UsageError("expected tests that need the development frames, but got none")
        return
    config.hook.pytest_deselected(items=needing)
    items[:] = [item for item in items if item not in needing]
