"""Check every link of HTML and Markdown files in some folders; those to other sites are listed, not followed.

    python scripts/howto/links.py FOLDER [FOLDER …]

A link is good where its file is there and has the heading or anchor that it names. Exit code 1 where one is not.
"""

import argparse
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

_FENCE = re.compile(r"^( *)```.*?^\1```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(?<!\!)\[(?:[^\[\]]|\[[^\]]*\])*\]\(([^)\s]+)\)|!\[[^\]]*\]\(([^)\s]+)\)")
_HEADING = re.compile(r"^#+ +(.*)$", re.MULTILINE)


class _Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Keep what links, and what can be linked to."""
        for name, value in attrs:
            if value and name in ("href", "src"):
                self.links.append(value)
            elif value and name in ("id", "name"):
                self.anchors.add(value)


@cache
def of(path: Path) -> tuple[list[str], set[str]]:
    """The links of a file, and its anchors."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".html":
        page = _Page()
        page.feed(text)
        return page.links, page.anchors
    text = _FENCE.sub("", text)
    return ["".join(match.groups("")) for match in _LINK.finditer(text)], set(slugs(_HEADING.findall(text)))


def slugs(headings: list[str]) -> Iterator[str]:
    """Anchors of headings as GitHub makes them.

    >>> list(slugs(["Fact & fancy: `a.py`", "Two", "Two"]))
    ['fact--fancy-apy', 'two', 'two-1']
    """
    seen: dict[str, int] = {}
    for heading in headings:
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        count = seen.get(slug, 0)
        seen[slug] = count + 1
        yield f"{slug}-{count}" if count else slug


def broken(path: Path) -> Iterator[str]:
    """What a file links to that is not there."""
    for link in of(path)[0]:
        parts = urlsplit(link)
        if parts.scheme in ("http", "https", "mailto", "data"):
            continue
        target = path if not parts.path else (path.parent / unquote(parts.path))
        anchored = parts.fragment and target.suffix in (".html", ".md")
        if not target.exists() or (anchored and unquote(parts.fragment) not in of(target)[1]):
            yield link


def files_of(folder: Path) -> list[Path]:
    """HTML and Markdown files of a folder; of a checkout those that Git keeps."""
    if (folder / ".git").exists():
        listed = subprocess.run(["git", "-C", str(folder), "ls-files"], capture_output=True, text=True, check=True)
        paths = [folder / name for name in listed.stdout.splitlines()]
    else:
        paths = sorted(folder.rglob("*"))
    return [path for path in paths if path.suffix in (".html", ".md") and path.is_file()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", metavar="FOLDER", nargs="+", type=Path)
    paths = [path for folder in parser.parse_args().folders for path in files_of(folder)]
    wrong = [f"{path}: {link}" for path in paths for link in broken(path)]
    print(*wrong, f"{len(paths)} files, {sum(len(of(path)[0]) for path in paths)} links, {len(wrong)} broken", sep="\n")
    sys.exit(1 if wrong or not paths else 0)


if __name__ == "__main__":
    main()
