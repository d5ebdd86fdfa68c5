"""Zip the Blender extension, with the render script that it calls.

    python scripts/blender/build_extension.py [DIR] [--wheels dist]

The zip is what Blender 4.2 and later install: Preferences → Get Extensions → Install from Disk. Needs nothing but
Python; the same files give the same bytes. With --wheels it brings selfcorrect's own wheels, and its panel says how to
install the one that fits. Blender's own Python does not load them, as it would have to load torch: selfcorrect is a
program beside it.
"""

import argparse
import tomllib
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
EXTENSION = HERE / "extension"
RENDER = HERE.parent / "render"


def build(folder: Path, wheels: Path | None = None) -> Path:
    """Write ``selfcorrect-blender-VERSION.zip`` into a folder and return its path."""
    manifest = tomllib.loads((EXTENSION / "blender_manifest.toml").read_text(encoding="utf-8"))
    files = [path for path in sorted(EXTENSION.iterdir()) if path.suffix in {".py", ".toml"}]
    files += [RENDER / "render_blender.py", RENDER / "halves.py", HERE.parent.parent / "LICENSE"]
    named = {path.name: path for path in files}
    if wheels is not None:
        named |= {f"wheels/{path.name}": path for path in sorted(wheels.glob("selfcorrect-*.whl"))}
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"selfcorrect-blender-{manifest['version']}.zip"
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, path in named.items():
            archive.writestr(zipfile.ZipInfo(name), path.read_bytes(), zipfile.ZIP_DEFLATED)
    return target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "folder", metavar="DIR", type=Path, nargs="?", default=Path(), help="for the zip; by default here"
    )
    parser.add_argument("--wheels", metavar="DIR", type=Path, help="with selfcorrect's wheels, to put in")
    options = parser.parse_args()
    if options.wheels is not None and not any(options.wheels.glob("selfcorrect-*.whl")):
        parser.error(f"expected wheels in {options.wheels} (sh scripts/build_wheels makes them), but got none")
    print(build(options.folder, options.wheels))


if __name__ == "__main__":
    main()
