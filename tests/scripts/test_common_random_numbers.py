"""Common random numbers in Mitsuba: neighbours' errors correlate; and the image from their differences."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.render_scripts import CHECKOUT

from selfcorrect import exr

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.llvm,
    # drjit's own modules, on import
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]

SCRIPTS = CHECKOUT / "scripts" / "render"

RENDERS = """
import sys
import numpy as np
import common_random_numbers as crn
from screened_poisson import screened_poisson

scenes = {c: crn.cornell_box(common=c, size=48) for c in (False, True)}
reference = np.mean([crn.render(scenes[False], 256, 100 + i) for i in range(4)], 0)
found = {"reference": reference}
for common, name in ((False, "independent"), (True, "common")):
    found[name] = np.stack([crn.render(scenes[common], 16, i) for i in range(32)])
again = crn.render(scenes[True], 16, 3)
assert np.array_equal(again, found["common"][3])
pairs = zip(found["independent"], found["common"])
found["poisson"] = np.stack([screened_poisson(y, z) for y, z in pairs])
sampler = crn.CommonRandomNumbers()
sampler.set_sample_count(8)
found["numbers"] = np.empty((16, 4, 24))
for seed, numbers in enumerate(found["numbers"]):
    sampler.seed(seed, 24)
    numbers[:] = [np.array(sampler.next_1d()) for _ in numbers]
np.savez(sys.argv[1], **found)
"""


@pytest.fixture(scope="module")
def renders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Rendered in a process of their own: Mitsuba's threads and variant are global."""
    path = tmp_path_factory.mktemp("crn") / "renders.npz"
    subprocess.run([sys.executable, "-c", RENDERS, str(path)], check=True, cwd=SCRIPTS)
    return dict(np.load(path))


def neighbours(error: np.ndarray) -> float:
    """Correlation of horizontally neighbouring pixels' errors."""
    left, right = error[:, :, 1:].mean(-1), error[:, :, :-1].mean(-1)
    return float((left * right).mean() / np.sqrt((left**2).mean() * (right**2).mean()))


def test_errors_of_neighbours_correlate(renders: dict[str, np.ndarray]) -> None:
    errors = {name: renders[name] - renders["reference"] for name in ("independent", "common")}
    assert abs(neighbours(errors["independent"])) < 0.15
    assert neighbours(errors["common"]) > 0.5
    assert errors["common"].std() < 1.3 * errors["independent"].std()
    assert abs(errors["common"].mean()) < 4 * errors["common"].mean((1, 2, 3)).std() / np.sqrt(32)


def test_pixels_share_numbers_and_seeds_do_not(renders: dict[str, np.ndarray]) -> None:
    pixels = renders["numbers"].reshape(16, 4, 3, 8)  # by seed, dimension, pixel and sample
    assert (pixels == pixels[:, :, :1]).all()
    assert len(np.unique(pixels[:, :, 0])) == 16 * 4 * 8


def test_screened_poisson_keeps_the_better_differences(renders: dict[str, np.ndarray]) -> None:
    """Errors of values do not tell: over 64 renders their mean comes to 0.5 to 1.1 of that of independent samples."""
    errors = {name: renders[name] - renders["reference"] for name in ("independent", "poisson")}
    error = {name: np.square(np.diff(of, axis=2)).mean() for name, of in errors.items()}
    assert error["poisson"] < 0.8 * error["independent"]


SCENE = """
<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="48"/><integer name="height" value="40"/></film>
    <sampler type="independent"/>
  </sensor>
  <shape type="sphere"/>
  <shape type="rectangle"><transform name="to_world"><scale value="3"/><translate z="-1"/></transform></shape>
  <emitter type="constant"/>
</scene>
"""


def neighbours_in(folder: Path) -> float:
    """Correlation of the noise of horizontal neighbours in the two halves of a folder."""
    a, b = (exr.load_half(str(path)).buffers["color"] for path in sorted(folder.glob("*.exr")))
    noise = (a - b).mean(-1)
    return float(np.corrcoef(noise[:, 1:].ravel(), noise[:, :-1].ravel())[0, 1])


def test_the_render_script_has_both_kinds(tmp_path: Path) -> None:
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    found = {}
    for kind in ("--crn", "--poisson", "--variant=llvm_ad_rgb"):
        command = [sys.executable, str(SCRIPTS / "render_mitsuba.py"), str(scene), "-o", str(tmp_path / kind), kind]
        subprocess.run([*command, "--spp", "16"], check=True)
        found[kind] = neighbours_in(tmp_path / kind)
    assert found["--crn"] > 0.5
    assert found["--poisson"] > 0.5
    assert abs(found["--variant=llvm_ad_rgb"]) < 0.1
