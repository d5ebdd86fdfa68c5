"""The report's pages in a real browser: what is seen, by pixel; keys, slider, widths, themes; and a silent console."""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.pages import ESTIMATE, FACTS, SIZE, images, maps, shown
from PIL import Image
from selenium import webdriver
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.common.keys import Keys

from selfcorrect import report

pytestmark = pytest.mark.browser

FLAGS = (
    "headless",
    "no-sandbox",
    "disable-gpu",
    "disable-quic",
    "no-first-run",
    "disable-background-networking",
    "disable-component-update",
    "disable-sync",
    "force-color-profile=srgb",
)
WIDTHS = (400, 1600)
THEMES = ("dark", "light")


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for flag in (*FLAGS, f"user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(str(shutil.which("chromedriver"))))
    yield driver
    driver.quit()


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Callable[..., Any]:
    def one(text: str, width: int = 1000, theme: str = "dark") -> Any:
        size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        media = [{"name": "prefers-color-scheme", "value": theme}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": media})
        (tmp_path / "page.html").write_text(text, encoding="utf-8")
        browser.get((tmp_path / "page.html").as_uri())
        until(lambda: browser.execute_script("return document.documentElement.dataset.ready") == "true")
        assert browser.get_log("browser") == []
        return browser

    return one


def until(there: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not there():
        assert time.monotonic() < end, "waited half a minute"
        time.sleep(0.05)


def frame_page() -> str:
    return report.frame_page(images(), maps(), FACTS)


def of_frame(number: int) -> dict[str, Any]:
    """Another frame's images: the more light, the later."""
    return {name: (image * number).astype(np.float16) for name, image in images().items()}


def shot_page() -> str:
    facts = {"estimate": ESTIMATE, "size": {"width": SIZE[1], "height": SIZE[0]}, "start": {"warm": True}}
    frames = [
        report.ShotFrame(
            number,
            "written",
            facts,
            images=of_frame(number),
            maps=maps(),
            thumbnail=report.thumbnail(images()["corrected"]),
            rows={name: report.slice_of(image) for name, image in images().items()},
        )
        for number in range(1, 5)
    ]
    return report.shot_page([*frames, report.ShotFrame(5, "failed", {"reason": "no such file"})], {"title": "shot"})


def bench_page() -> str:
    names = {"fast:window=7": 0.6, "fast": 1.0, "balanced": 4.0, "best": 16.0}
    points = [
        {"point": name, "ratio": 0.9 - 0.02 * i, "standard_error": 0.01, "train": t, "infer": 0.5, "settings": {}}
        | {"preset": ":" not in name}
        for i, (name, t) in enumerate(names.items())
    ]
    return report.bench_page(points, list(names), "fast", {"title": "a.exr"})


PAGES = {"frame": frame_page, "shot": shot_page, "bench": bench_page}


def pixel(driver: Any, x: int, y: int, size: tuple[int, int] = SIZE) -> Any:
    """What is on the screen in the middle of a pixel of the image, as it fits into the stage."""
    box = driver.execute_script(
        "const s = document.querySelector('.stage'); s.scrollIntoView({block: 'center'});"
        "const b = s.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"
    )
    zoom = min(box[2] / size[1], box[3] / size[0])
    left, top = box[0] + (box[2] - zoom * size[1]) / 2, box[1] + (box[3] - zoom * size[0]) / 2
    screen = np.asarray(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB"), np.int64)
    return screen[round(top + (y + 0.5) * zoom), round(left + (x + 0.5) * zoom)]


def picture(stage: Any) -> Any:
    """A whole stage, as it is on the screen."""
    return np.asarray(Image.open(io.BytesIO(stage.screenshot_as_png)).convert("RGB"), np.int64)


def press(driver: Any, *keys: str) -> None:
    ActionChains(driver).send_keys(*keys).perform()


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("kind", PAGES)
def test_fits_its_width_in_both_themes(opened: Any, kind: str, width: int, theme: str) -> None:
    driver = opened(PAGES[kind](), width, theme)
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width
    ground, text = (
        driver.execute_script(f"return getComputedStyle(document.body).{name}") for name in ("backgroundColor", "color")
    )
    levels = [sum(int(v) for v in color[4:-1].split(",")) for color in (ground, text)]
    assert (levels[0] < levels[1]) == (theme == "dark")
    assert abs(levels[0] - levels[1]) > 3 * 150


@pytest.mark.parametrize("kind", PAGES)
def test_everything_to_work_with_has_a_name(opened: Any, kind: str) -> None:
    driver = opened(PAGES[kind]())
    found = driver.find_elements(By.CSS_SELECTOR, "button, select, input, [tabindex], [role=img], [role=slider], meter")
    assert found
    assert [one.get_attribute("outerHTML") for one in found if not one.accessible_name.strip()] == []


class TestFrame:
    def test_the_slider_stands_between_denoised_and_corrected(self, opened: Any) -> None:
        driver = opened(frame_page())
        np.testing.assert_array_equal(pixel(driver, 2, 5), shown(images()["denoised"][5, 2]))
        np.testing.assert_array_equal(pixel(driver, 13, 5), shown(images()["corrected"][5, 13]))

    def test_the_divider_is_drawn_and_moved_by_keys(self, opened: Any) -> None:
        driver = opened(frame_page())
        divider = driver.find_element(By.CSS_SELECTOR, ".divider")
        stage = driver.find_element(By.CSS_SELECTOR, ".stage")
        ActionChains(driver).drag_and_drop_by_offset(divider, round(0.4 * stage.size["width"]), 0).perform()
        np.testing.assert_array_equal(pixel(driver, 11, 5), shown(images()["denoised"][5, 11]))
        assert divider.get_attribute("aria-valuenow") == "90"
        divider.send_keys(Keys.HOME)
        np.testing.assert_array_equal(pixel(driver, 2, 5), shown(images()["corrected"][5, 2]))
        divider.send_keys(Keys.END, Keys.ARROW_LEFT)
        assert divider.get_attribute("aria-valuenow") == "98"

    def test_keys_choose_images_and_space_flips(self, opened: Any) -> None:
        driver = opened(frame_page())
        for key, name in zip("1234", images(), strict=True):
            press(driver, key)
            np.testing.assert_array_equal(pixel(driver, 4, 3), shown(images()[name][3, 4]))
        press(driver, "2", "3", " ")
        np.testing.assert_array_equal(pixel(driver, 4, 3), shown(images()["denoised"][3, 4]))
        press(driver, " ")
        np.testing.assert_array_equal(pixel(driver, 4, 3), shown(images()["corrected"][3, 4]))

    def test_space_flips_after_a_click_on_an_image(self, opened: Any) -> None:
        driver = opened(frame_page())
        driver.find_element(By.CSS_SELECTOR, "[data-layer=noisy]").click()
        press(driver, " ")
        np.testing.assert_array_equal(pixel(driver, 4, 3), shown(images()["corrected"][3, 4]))

    def test_exposure(self, opened: Any) -> None:
        driver = opened(frame_page())
        press(driver, "3", "[", "[", "[", "[")
        np.testing.assert_array_equal(pixel(driver, 4, 3), shown(images()["corrected"][3, 4], -2))
        driver.find_element(By.CSS_SELECTOR, "input[type=range]").send_keys(Keys.ARROW_RIGHT)
        np.testing.assert_array_equal(pixel(driver, 4, 3), shown(images()["corrected"][3, 4], -1.75))

    def test_tone_mapping(self, opened: Any) -> None:
        driver = opened(frame_page())
        press(driver, "3")
        driver.find_element(By.CSS_SELECTOR, "[aria-label='Tone mapping']").send_keys("Reinhard")
        x = images()["corrected"][3, 4].astype(np.float64)
        np.testing.assert_array_equal(pixel(driver, 4, 3), shown(x / (1 + x)))

    def test_zoom_and_pan_go_for_all_images(self, opened: Any) -> None:
        """Side by side, zoomed to single pixels: the same pixel in the middle of every stage."""
        driver = opened(frame_page(), 1600)
        press(driver, "g", "+", "+", "+")
        stages = driver.find_elements(By.CSS_SELECTOR, ".stage")
        assert len(stages) == len(images()) + len(maps()) + 3  # the change, and two true errors
        stages[0].click()
        stages[0].send_keys(Keys.ARROW_RIGHT)
        for stage, image in zip(stages, images().values(), strict=False):
            driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", stage)
            screen = picture(stage)
            seen = screen[screen.shape[0] // 2 + 5, screen.shape[1] // 2 + 5]
            caption = driver.find_element(By.CSS_SELECTOR, ".inspector caption").text
            x, y = (int(word.strip(",")) for word in caption.split()[1:3])
            np.testing.assert_array_equal(seen, shown(image[y, x]))

    def test_the_pixel_under_the_pointer(self, opened: Any) -> None:
        driver = opened(frame_page())
        stage = driver.find_element(By.CSS_SELECTOR, ".stage")
        driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", stage)
        zoom = min(stage.size["width"] / SIZE[1], stage.size["height"] / SIZE[0])
        ActionChains(driver).move_to_element_with_offset(stage, round(2.5 * zoom), round(-1.5 * zoom)).perform()
        text = driver.find_element(By.CSS_SELECTOR, ".inspector").text
        x, y = SIZE[1] // 2 + 2, SIZE[0] // 2 - 2
        assert f"Pixel {x}, {y}, linear" in text
        assert f"{images()['noisy'][y, x, 0]:#.3g}" in text

    def test_maps_in_false_colours_with_a_legend(self, opened: Any) -> None:
        driver = opened(frame_page())
        press(driver, "8")
        assert "Blend weight" in driver.find_element(By.CSS_SELECTOR, ".legend").text
        lowest, highest = np.array([0x44, 0x01, 0x54]), np.array([0xFD, 0xE7, 0x25])
        blend = maps()["blend"]
        for where, colour in ((blend.argmin(), lowest), (blend.argmax(), highest)):
            y, x = divmod(int(where), SIZE[1])
            assert np.abs(pixel(driver, x, y) - colour).max() < 16


def test_a_dark_frame_is_exposed(opened: Any) -> None:
    dark = {name: (image * 1e-4).astype(np.float16) for name, image in images().items()}
    driver = opened(report.frame_page(dark, {}, FACTS))
    assert float(driver.find_element(By.CSS_SELECTOR, "input[type=range]").get_property("value")) > 4


def reduced_page() -> tuple[str, dict[str, Any]]:
    """A frame that has to be reduced, changed in a corner, and its images."""
    denoised = np.random.default_rng(9).gamma(2.0, 0.2, (800, 1300, 3)).astype(np.float16)
    large = {"denoised": denoised, "corrected": denoised.copy()}
    large["corrected"][10:20, 330:340] = 9
    return report.frame_page(large, {}, FACTS), large


def test_what_was_changed_most_in_every_pixel(opened: Any) -> None:
    text, large = reduced_page()
    driver = opened(text)
    whole, detail = driver.find_elements(By.CSS_SELECTOR, "[aria-label=Region] button")
    assert whole.get_attribute("aria-pressed") == "true"
    detail.click()
    until(lambda: detail.get_attribute("aria-pressed") == "true")
    driver.find_element(By.CSS_SELECTOR, "[data-layer=corrected]").click()
    np.testing.assert_array_equal(pixel(driver, 10, 10, (320, 320)), [255, 255, 255])
    np.testing.assert_array_equal(pixel(driver, 200, 100, (320, 320)), shown(large["corrected"][100, 520]))


def test_the_region_asked_for_last_is_shown(opened: Any) -> None:
    """Though the other one, which had to be unpacked first, was asked for a moment before."""
    driver = opened(reduced_page()[0])
    buttons = driver.find_elements(By.CSS_SELECTOR, "[aria-label=Region] button")
    stage = driver.find_element(By.CSS_SELECTOR, ".stage")
    pressed, whole = [button.get_attribute("aria-pressed") for button in buttons], picture(stage)
    unpacked = driver.execute_async_script(
        "const [[whole, detail], done] = arguments, reads = [], read = Response.prototype.arrayBuffer;"
        "Response.prototype.arrayBuffer = function () { const r = read.call(this); reads.push(r); return r; };"
        "detail.click(); whole.click();"
        "Promise.all(reads).then(() => setTimeout(done, 0, reads.length));",
        buttons,
    )
    assert unpacked == 2
    assert [button.get_attribute("aria-pressed") for button in buttons] == pressed
    np.testing.assert_array_equal(picture(stage), whole)


def test_a_frame_with_nan_opens(opened: Any) -> None:
    broken = images()
    broken["noisy"][2, 3:6] = np.nan
    broken["corrected"][3, 4] = np.inf
    driver = opened(report.frame_page(broken, maps(), FACTS))
    for key, name, expected in (("1", "noisy", 0), ("3", "corrected", 255)):
        press(driver, key)
        y, x = (int(at[0]) for at in np.nonzero(~np.isfinite(broken[name].sum(-1))))
        np.testing.assert_array_equal(pixel(driver, x, y), [expected] * 3)
    assert "NaN or infinite" in driver.find_element(By.TAG_NAME, "body").text


class TestWhereThingsStand:
    """What is looked at together is seen together."""

    def box(self, driver: Any, selector: str) -> Any:
        return driver.find_element(By.CSS_SELECTOR, selector).rect

    def test_numbers_beside_the_image_where_there_is_room(self, opened: Any) -> None:
        driver = opened(frame_page(), 1600)
        stage, numbers = self.box(driver, ".stage"), self.box(driver, ".inspector")
        assert stage["x"] + stage["width"] <= numbers["x"]
        assert stage["y"] <= numbers["y"] <= stage["y"] + 0.1 * stage["height"]
        press(driver, "g")
        assert self.box(driver, ".inspector")["y"] > self.box(driver, ".stage")["y"]
        assert self.box(driver, ".inspector")["x"] < 100

    def test_the_image_before_the_tools_where_there_is_none(self, opened: Any) -> None:
        driver = opened(frame_page(), 400)
        stage, tools, numbers = (self.box(driver, name) for name in (".stage", ".tools", ".inspector"))
        assert stage["y"] + stage["height"] <= tools["y"] <= numbers["y"]
        assert stage["y"] < 700

    def test_the_errors_of_bench_are_seen_without_scrolling(self, opened: Any) -> None:
        driver = opened(bench_page(), 400)
        for column in (1, 2, 3):
            cell = self.box(driver, f".points tbody tr :nth-child({column})")
            assert cell["x"] + cell["width"] <= 400

    def test_a_caption_is_read_without_scrolling(self, opened: Any) -> None:
        driver = opened(bench_page(), 400)
        caption = self.box(driver, ".points caption")
        assert self.box(driver, ".points")["width"] > 400
        assert caption["x"] + caption["width"] <= 400


def test_the_frame_asked_for_last_is_shown(opened: Any) -> None:
    """Though another one, which had to be unpacked first, was asked for a moment before."""
    driver = opened(shot_page())
    driver.execute_async_script(
        "const done = arguments[0], buttons = document.querySelectorAll('.frames button');"
        "buttons[1].click(); buttons[0].click(); setTimeout(done, 500)"
    )
    press(driver, "3")
    np.testing.assert_array_equal(pixel(driver, 4, 3), shown(of_frame(1)["corrected"][3, 4]))


def test_a_frame_of_a_shot_is_chosen(opened: Any) -> None:
    driver = opened(shot_page())
    buttons = driver.find_elements(By.CSS_SELECTOR, ".frames button")
    assert [button.is_enabled() for button in buttons] == [True] * 4 + [False]
    buttons[2].click()
    until(lambda: buttons[2].get_attribute("aria-pressed") == "true")
    assert "−31 %" in buttons[2].text
    assert len(driver.find_elements(By.CSS_SELECTOR, ".slices canvas")) == len(images())


def test_a_budget_chooses_a_point(opened: Any) -> None:
    driver = opened(bench_page())
    told = driver.find_element(By.CSS_SELECTOR, ".told")
    assert told.text.startswith("fast:")
    slider = driver.find_element(By.CSS_SELECTOR, "input[type=range]")
    slider.send_keys(Keys.HOME)
    assert told.text.startswith("fast:window=7:")
    slider.send_keys(Keys.END, Keys.ARROW_LEFT)
    assert told.text.startswith("balanced:")
    ActionChains(driver).key_down(Keys.SHIFT).send_keys(Keys.TAB).key_up(Keys.SHIFT).perform()
    assert told.text.startswith("best:")
