"""Writes the table of buffers as rows of terms.h, for the build: called with the path of buffers.py."""

import runpy
import sys


def rows(path: str) -> str:
    """One initialiser of terms.h's Term for each row of TERMS."""
    table = runpy.run_path(path)
    lines = []
    for term in table["TERMS"]:
        always = term.kind == "radiance"
        flags = (always, term.scale, term.distance == "logarithmic")
        values = (f'"{term.name}"', str(term.channels), str(term.place), *(str(flag).lower() for flag in flags))
        lines.append(f"{{{', '.join(values)}}},\n")
    return "".join(lines)


if __name__ == "__main__":
    sys.stdout.write(rows(sys.argv[1]))
