"""The rule of the house: data walks one way, and only the command prints."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

import selfcorrect

PACKAGE = Path(selfcorrect.__file__).parent
ORDER = (
    {"errors", "publish", "buffers", "settings", "start", "words", "output"},
    {"image"},
    {"kernel"},
    {"frame", "exr"},
    {"stages", "pooling"},
    {"guard", "fireflies", "independence", "lone_pixels", "metrics"},
    {"sums", "history"},
    {"correct", "candidates", "aovs"},
    {"aov_channels"},
    {"renders"},
    {"files", "facts"},
    {"shot", "tradeoff", "report"},
    {"cli"},
)
"""The rooms, the lowest first; those of one level know nothing of each other, but for the lowest level."""

LEVEL = {room: level for level, rooms in enumerate(ORDER) for room in rooms}
MODULES = sorted(path.relative_to(PACKAGE) for path in PACKAGE.rglob("*.py"))
BUILD = {Path("kernel/cross_bilateral/rows.py")}  # run by the build, which reads what it prints
OUTSIDE = {Path("__init__.py"), Path("__main__.py")}  # what the package shows of itself, and how it is started


ROOT = Path(__file__).parents[1]
NAMED = re.compile(r"(?<![\w/*.>-])(?:tests|scripts)/[\w/.-]*\w")
"""Paths of the checkout in sources and prose."""


def room_of(module: Path) -> str:
    return module.parts[0].removesuffix(".py")


def imported(tree: ast.AST) -> Iterator[str]:
    """The rooms that a module imports, wherever in it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert not node.level, "relative imports hide where they lead"
            names = [node.module or ""]
            if node.module == "selfcorrect":
                names = [f"selfcorrect.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            package, _, rest = name.partition(".")
            if package == "selfcorrect":
                yield rest.partition(".")[0]


def wrong(module: Path, source: str) -> list[str]:
    """What a module imports although it lies above or beside."""
    own = room_of(module)
    rooms = set(imported(ast.parse(source))) - {own}
    return sorted(room for room in rooms if LEVEL[room] > LEVEL[own] or LEVEL[room] == LEVEL[own] > 0)


def prints(source: str) -> bool:
    """Whether a module calls print, or writes to stdout or stderr."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print":
            return True
        if isinstance(node, ast.Attribute) and node.attr in ("stdout", "stderr"):
            return True
    return False


def missing(text: str) -> list[str]:
    """Paths of the checkout that a text names and that are not there."""
    return sorted({path for path in NAMED.findall(text) if not (ROOT / path).exists()})


def test_every_module_has_its_room() -> None:
    assert {room_of(module) for module in MODULES if module not in OUTSIDE} == set(LEVEL)


def test_no_module_imports_from_a_room_above_it() -> None:
    sources = {module: (PACKAGE / module).read_text(encoding="utf-8") for module in MODULES if module not in OUTSIDE}
    assert {module: rooms for module, source in sources.items() if (rooms := wrong(module, source))} == {}


def test_only_the_command_prints() -> None:
    others = [module for module in MODULES if room_of(module) != "cli" and module not in BUILD]
    assert [module for module in others if prints((PACKAGE / module).read_text(encoding="utf-8"))] == []


def test_paths_that_texts_name_are_there() -> None:
    kinds = {".py", ".md", ".toml", ".yaml", ".js", ".h", ".cpp", ".txt", ""}
    rooms = [*(ROOT / name for name in ("selfcorrect", "denoisers", "scripts", "tests")), ROOT]
    files = {path for room in rooms[:-1] for path in room.rglob("*") if path.suffix in kinds and path.is_file()}
    files |= {path for path in ROOT.iterdir() if path.suffix in {".md", ".toml"}}
    texts = {path.relative_to(ROOT): path.read_text(encoding="utf-8") for path in files - {Path(__file__)}}
    assert {str(path): names for path, text in texts.items() if (names := missing(text))} == {}


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("``tests/test_memory.py`` holds it", ["tests/test_memory.py"]),
        ("see scripts/bench/quality.py, and tests/cli/test_memory.py.", []),
        ("python scripts/nothing", ["scripts/nothing"]),
        ("bpy/*/scripts/addons_core of Blender", []),
    ],
)
def test_a_missing_path_would_be_seen(text: str, names: list[str]) -> None:
    assert missing(text) == names


@pytest.mark.parametrize(
    ("module", "source", "rooms"),
    [
        ("frame.py", "from selfcorrect.stages.core import train", ["stages"]),
        ("frame.py", "def late():\n    from selfcorrect import correct, errors", ["correct"]),
        ("exr/file.py", "import selfcorrect.frame as f", ["frame"]),
        ("shot/run.py", "from selfcorrect.cli.terminal import log", ["cli"]),
        ("shot/run.py", "from selfcorrect.shot.chain import Chain\nfrom selfcorrect import files\nimport torch", []),
    ],
)
def test_a_wrong_import_would_be_seen(module: str, source: str, rooms: list[str]) -> None:
    assert wrong(Path(module), source) == rooms


@pytest.mark.parametrize(
    ("source", "seen"),
    [("print(1)", True), ("import sys; sys.stderr.write('x')", True), ("# print()\nprinted = 'print(1)'", False)],
)
def test_a_print_would_be_seen(source: str, seen: bool) -> None:
    assert prints(source) is seen
