"""Every text of an error, in one place to read: writes ERRORS.md beside this script.

    python scripts/bench/error_texts.py

The texts stay where they are raised, beside the values that they tell of; this collects them from the source, and
`tests/scripts/test_error_texts.py` holds the list against it.
"""

import argparse
import ast
from collections.abc import Iterator
from pathlib import Path

from selfcorrect import errors

ROOT = Path(__file__).resolve().parent.parent.parent
PAGE = ROOT / "scripts" / "bench" / "ERRORS.md"
PACKAGES = ("selfcorrect", "denoisers")
OURS = set(errors.__all__) - {"MissingPackageError"}
"""That one names the command that installs what is missing."""

HEAD = """# Errors

Every error that a user may see, as `python scripts/bench/error_texts.py` finds them in the source. A text says what
was expected, what came instead and what to do; the file comes first where there is one. `{…}` is filled in when it is
raised.
"""


def texts(source: str) -> Iterator[tuple[str, str]]:
    """Class and text of every error that a module raises or returns, in order; texts made elsewhere are left out."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in OURS and node.args:
            text = written(node.args[0])
            if text:
                yield node.func.id, text


def written(node: ast.expr) -> str:
    """The text of a literal, with its values in braces; empty of anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = [
            part.value if isinstance(part, ast.Constant) else "{" + ast.unparse(part.value) + "}"
            for part in node.values
            if isinstance(part, (ast.Constant, ast.FormattedValue))
        ]
        return "".join(map(str, parts))
    return ""


def page() -> str:
    """The page, module by module."""
    sections = [HEAD]
    for package in PACKAGES:
        for module in sorted((ROOT / package).rglob("*.py")):
            found = dict.fromkeys(texts(module.read_text(encoding="utf-8")))
            if found:
                lines = sorted(f"- {kind}: {' '.join(text.split())}" for kind, text in found)
                sections.append(f"## {module.relative_to(ROOT).as_posix()}\n" + "\n".join(lines) + "\n")
    return "\n".join(sections)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    PAGE.write_text(page(), encoding="utf-8")
