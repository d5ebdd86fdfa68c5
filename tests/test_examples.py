"""Examples in docstrings and how-tos are true: they run."""

import doctest
import importlib
import re
import shutil
from pathlib import Path

import links
import pytest
import torch

import denoisers
import selfcorrect

ROOT = Path(__file__).parents[1]
HOWTO = ROOT / "scripts" / "howto"
EXAMPLE = re.compile("^ *>>> ", re.MULTILINE)
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def named(package: Path) -> list[str]:
    """Modules of a package that have an example."""
    paths = [path for path in package.rglob("*.py") if EXAMPLE.search(path.read_text(encoding="utf-8"))]
    parts = [path.relative_to(package.parent).with_suffix("").parts for path in paths]
    return sorted(".".join(names).removesuffix(".__init__") for names in parts)


MODULES = [name for package in (selfcorrect, denoisers) for name in named(Path(package.__file__).parent)]


def test_there_are_some() -> None:
    assert {"selfcorrect.errors", "selfcorrect.settings", "denoisers"} <= set(MODULES)


@pytest.mark.parametrize("name", MODULES)
def test_docstrings(name: str) -> None:
    image = torch.rand(24, 20, 3, generator=torch.Generator().manual_seed(1))
    beside = {"color": image, "albedo": image, "normal": image}
    tried = doctest.testmod(importlib.import_module(name), extraglobs=beside)
    assert tried.attempted > 0
    assert tried.failed == 0


def test_the_programmers_how_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its blocks one after the other, on the packaged frame, as it says."""
    blocks = PYTHON.findall((HOWTO / "python.md").read_text(encoding="utf-8"))
    assert len(blocks) >= 3
    for half in "AB":
        data = Path(selfcorrect.__file__).parent / "data" / f"demo_064spp_{half}.exr"
        shutil.copyfile(data, tmp_path / f"{half}.exr")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(selfcorrect.Settings, "default", classmethod(lambda cls: "fast"))
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "python.md", "exec"), names)
    assert (tmp_path / "OUT.exr").is_file()


def test_links_of_markdown_files() -> None:
    paths = links.files_of(ROOT)
    assert len(paths) >= 10
    assert {str(path): wrong for path in paths if (wrong := list(links.broken(path)))} == {}


def test_a_broken_link_would_be_seen(tmp_path: Path) -> None:
    (tmp_path / "there.md").write_text("# One heading\n")
    text = "[a](there.md) [b](there.md#one-heading) [c](there.md#two) [d](gone.md) ![e](gone.png) [f](https://x.org)"
    (tmp_path / "page.md").write_text(text)
    (tmp_path / "page.html").write_text('<a href="#x"></a><a href="#y" id="y"></a><img src="gone.png">')
    assert list(links.broken(tmp_path / "page.md")) == ["there.md#two", "gone.md", "gone.png"]
    assert list(links.broken(tmp_path / "page.html")) == ["#x", "gone.png"]
    assert doctest.testmod(links).failed == 0
