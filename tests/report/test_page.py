"""The report's pages as text: what they hold, say and escape. What a browser makes of them is tested beside."""

import re
from typing import Any

import numpy as np
import pytest
from helpers.pages import ESTIMATE, FACTS, data_of, images, maps, unpacked

from selfcorrect import report, words
from selfcorrect.report.pack import pack, reduced
from selfcorrect.settings import Settings

LARGEST = 65504.0
POINTS = [
    {"point": name, "ratio": ratio, "standard_error": 0.01, "train": t, "infer": 0.5, "preset": preset, "settings": {}}
    for name, ratio, t, preset in (
        ("fast", 0.8, 1.0, True),
        ("best", 0.7, 9.0, True),
        ("fast:window=7", 0.9, 0.5, False),
    )
]


class TestPack:
    @pytest.mark.parametrize("shape", [(1, 1, 3), (1, 7, 3), (5, 1), (9, 13, 3), (8, 8)])
    def test_comes_back_bit_by_bit(self, shape: tuple[int, ...]) -> None:
        image = np.random.default_rng(1).gamma(0.2, 100, shape).astype(np.float16)
        image.flat[0] = LARGEST
        image.flat[-1] = 0
        planes = unpacked(pack(image)._asdict())
        np.testing.assert_array_equal(np.moveaxis(planes, 0, -1).reshape(shape), image)

    def test_extremes_side_by_side(self) -> None:
        """Differences of colours and predictions go as far as 16 bits do."""
        image = np.random.default_rng(2).choice([0.0, 6e-8, LARGEST], (11, 17, 3)).astype(np.float16)
        np.testing.assert_array_equal(np.moveaxis(unpacked(pack(image)._asdict()), 0, -1), image)

    def test_rounded(self) -> None:
        image = np.random.default_rng(3).gamma(1.0, 1.0, (16, 16, 3)).astype(np.float16)
        image[0, 0] = LARGEST
        again = np.moveaxis(unpacked(pack(image, 7)._asdict()), 0, -1)
        np.testing.assert_allclose(again.astype(np.float64), image.astype(np.float64), rtol=2**-8, atol=1e-5)

    def test_what_is_no_radiance(self) -> None:
        image = np.array([[[np.nan, -1.0, np.inf]]], np.float32)
        np.testing.assert_array_equal(unpacked(pack(image)._asdict()).ravel(), [0, 0, LARGEST])

    def test_reduced_to_means(self) -> None:
        image = np.arange(15.0).reshape(3, 5)
        np.testing.assert_allclose(reduced(image, 2), [[3, 5, 6.5], [10.5, 12.5, 14]])


class TestFramePage:
    def test_holds_the_images(self) -> None:
        page = report.frame_page(images(), maps(), FACTS)
        layers = {layer["name"]: layer for layer in data_of(page)["layers"]}
        assert list(layers) == [*images(), *maps()]
        for name, image in images().items():
            np.testing.assert_array_equal(np.moveaxis(unpacked(layers[name]), 0, -1), image)

    def test_says_what_was_done(self) -> None:
        page = report.frame_page(images(), maps(), FACTS | {"settings": Settings.preset("fast", window=7).to_dict()})
        assert "Error about 31 % lower" in page
        assert "NaN or infinite" in page
        assert "Changed from the preset fast" in page
        assert "16 × 12 pixels" in page

    def test_needs_no_network_and_runs_no_other_script(self) -> None:
        page = report.frame_page(images(), maps(), FACTS)
        assert "default-src 'none'" in page
        without = page.replace("http://www.w3.org/2000/svg", "")  # a name, which is not fetched
        assert not re.search(r"https?:|//cdn|@import|url\(", without)
        assert len(re.findall("<script", page)) == 2

    def test_escapes_what_comes_from_files(self) -> None:
        evil = "</script><img src=x onerror=alert(1)>&'\""
        facts: dict[str, Any] = FACTS | {
            "title": evil,
            "denoiser": evil,
            "preset": evil,
            "channels": {evil: [evil]},
            "constant": [evil],
            "settings": {evil: evil},
            "repairs": {evil: {"non_finite": 1, "negative": 0}},
            "seconds": {evil: 1.0},
        }
        pages = [
            report.frame_page(images(), {}, facts),
            report.shot_page([report.ShotFrame(1, "failed", {"reason": evil})], facts),
            report.bench_page([POINTS[0] | {"point": evil}], [evil], evil, {"title": evil, "denoiser": evil}),
        ]
        for page in pages:
            assert "<img" not in page
            assert len(re.findall("</script", page)) == 2

    def test_a_name_that_is_no_unicode(self) -> None:
        page = report.frame_page(images(), {}, FACTS | {"title": "caf\udce9.exr", "channels": {"color": ["\udce9"]}})
        assert "caf\\udce9.exr" in page
        page.encode()

    def test_images_that_are_not_finite(self) -> None:
        broken = images()
        broken["noisy"][2, 3] = np.nan
        broken["noisy"][0, 0] = np.inf
        layer = data_of(report.frame_page(broken, {}, FACTS))["layers"][0]
        assert np.isfinite(unpacked(layer)).all()

    def test_a_large_frame_fits_and_says_so(self) -> None:
        generator = np.random.default_rng(4)
        large = {
            name: generator.gamma(1.0, 1.0, (540, 960, 3)).astype(np.float16) for name in ("denoised", "corrected")
        }
        facts = FACTS | {"size": {"width": 960, "height": 540}}
        page = report.frame_page(large, {}, facts, limit=6_000_000)
        assert len(page.encode()) <= 6_000_000
        assert data_of(page)["layers"][0]["width"] < 960
        assert "to stay small" in page
        detail = data_of(page)["detail"]
        left, top = int(detail["left"]), int(detail["top"])
        crop = np.moveaxis(unpacked(detail["layers"][1]), 0, -1)
        np.testing.assert_array_equal(crop, large["corrected"][top : top + 320, left : left + 320])
        assert detail["label"] == "Most changed, every pixel"

    def test_a_frame_that_came_reduced_promises_no_pixels(self) -> None:
        """Above two megapixels the page is given means of pixels: its detail is none of the frame's own."""
        generator = np.random.default_rng(4)
        large = {
            name: generator.gamma(1.0, 1.0, (540, 960, 3)).astype(np.float16) for name in ("denoised", "corrected")
        }
        facts = FACTS | {"size": {"width": 1920, "height": 1080}}
        page = report.frame_page(large, {}, facts, limit=6_000_000)
        assert data_of(page)["detail"]["label"] == "Most changed, 2 × 2 pixels in one"
        assert "every pixel" not in page

    def test_rounds_before_it_reduces(self) -> None:
        image = {"denoised": np.random.default_rng(5).gamma(1.0, 1.0, (128, 128, 3)).astype(np.float16)}
        whole = len(pack(image["denoised"]).data)
        page = report.frame_page(image, {}, {"title": "x"}, limit=300_000 + int(0.95 * whole))
        (layer,) = data_of(page)["layers"]
        assert (layer["width"], layer["bits"]) == (128, 7)
        assert "rounded" in page

    def test_the_same_page_again(self) -> None:
        assert report.frame_page(images(), maps(), FACTS) == report.frame_page(images(), maps(), FACTS)


class TestShotPage:
    def test_a_long_shot_fits(self) -> None:
        size = (90, 160)
        shown = report.shot.looked_at(range(1, 301))
        assert len(shown) == 6
        assert {1, 300} <= shown
        generator = np.random.default_rng(6)
        frames = []
        for number in range(1, 301):
            image = generator.gamma(1.0, 1.0, (*size, 3)).astype(np.float16)
            kept = {"images": {"corrected": image}} if number in shown else {}
            facts = {"estimate": ESTIMATE, "size": {"width": size[1], "height": size[0]}}
            rows = {"corrected": report.slice_of(image)}
            frames.append(
                report.ShotFrame(number, "written", facts, thumbnail=report.thumbnail(image), rows=rows, **kept)
            )
        page = report.shot_page(frames, {"title": "shot"}, limit=2_000_000)
        assert len(page.encode()) <= 2_000_000
        data = data_of(page)
        assert len(data["frames"]) == 300
        assert sum(bool(frame["layers"]) for frame in data["frames"]) == 6
        assert "Error about 31 % lower over the shot.<" in page

    def test_the_least_and_the_most_gain_of_a_shot(self) -> None:
        changes = (-0.31, -0.1, -0.5)
        frames = [
            report.ShotFrame(number, "written", {"estimate": ESTIMATE | {"change": change}})
            for number, change in enumerate(changes, 1)
        ]
        page = report.shot_page(frames, {"title": "shot"})
        assert "lower over the shot, from −10 % in frame 2 to −50 % in frame 3.<" in page

    def test_of_frames_that_failed_or_were_there(self) -> None:
        frames = [report.ShotFrame(1, "failed", {"reason": "no file"}), report.ShotFrame(2, "skipped", {})]
        page = report.shot_page(frames, {"title": "shot"})
        assert "no file" in page
        assert "1 were there" in page
        assert "1 failed" in page


def test_bench_page() -> None:
    page = report.bench_page(POINTS, ["fast:window=7", "fast", "best"], "fast", {"title": "a.exr"})
    assert "Take fast: error about 20 % lower in 1.5 s" in page
    assert [point["recommended"] for point in data_of(page)["points"]] == [True, False, False]


class TestWords:
    def test_where_the_gain_is(self) -> None:
        image = np.full((8, 8, 3), 0.2)
        image[:2], image[-2:] = 0.01, 5.0
        none = np.zeros((8, 8))
        for rows, name in ((slice(0, 2), "shadows"), (slice(2, 6), "mid-tones"), (slice(6, 8), "highlights")):
            before = none.copy()
            before[rows] = 1
            assert words.where(image, before, none) == f"mostly in the {name}"
        assert words.where(image, np.ones((8, 8)) * [[1], [1], [0.5], [0.5], [0.5], [0.5], [1], [1]], none) == (
            "all over the frame"
        )
        assert words.where(image, none, none) == ""

    def test_summaries(self) -> None:
        assert words.summary(ESTIMATE, "mostly in the highlights") == "Error about 31 % lower, mostly in the highlights"
        assert words.summary(ESTIMATE | {"change": -0.001}) == "Error less than 1 % lower"
        assert words.summary(ESTIMATE | {"improved": False, "change": 0.0}) == words.KEPT
        assert words.summary(None) == "No estimate of the error"
