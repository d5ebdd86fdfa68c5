"""Zip the Blender extension, with the render script that it calls.

    python scripts/blender/build_extension.py [DIR]

The zip is what Blender 4.2 and later install: Preferences → Get Extensions → Install from Disk. Needs nothing but
Python; the same files give the same bytes.
"""

import argparse
import tomllib
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
EXTENSION = HERE / "extension"
RENDER = HERE.parent / "render"


def build(folder: Path) -> Path:
    """Write ``selfcorrect-blender-VERSION.zip`` into a folder and return its path."""
    manifest = tomllib.loads((EXTENSION / "blender_manifest.toml").read_text(encoding="utf-8"))
    files = [path for path in sorted(EXTENSION.iterdir()) if path.suffix in {".py", ".toml"}]
    files += [RENDER / "render_blender.py", RENDER / "halves.py", HERE.parent.parent / "LICENSE"]
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"selfcorrect-blender-{manifest['version']}.zip"
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
            archive.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)
    return target


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "folder", metavar="DIR", type=Path, nargs="?", default=Path(), help="for the zip; by default here"
    )
    print(build(parser.parse_args().folder))


if __name__ == "__main__":
    main()
