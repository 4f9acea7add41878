"""The report: one page that holds everything, escapes every name, and works by mouse and by keyboard in a browser."""

import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest

from aaplug.core.cameras import CameraSet
from aaplug.core.training import TrainingViews
from aaplug.evaluation.report.plots import plots
from aaplug.inspection.coverage import coverage
from aaplug.io.images import image_size, write_png
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.evaluate import evaluate
from tests.conftest import make_camera, make_scene

NASTY = "</script><script>alert('x')</script>&amp;$\\frac$ “r_0”"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")  # fmt: skip
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a report of two views with nasty names, the report and the sampling bounds it shows."""
    folder: Path = tmp_path_factory.mktemp("report")
    scene = make_scene(150)
    views = [make_camera((0.0, -4.0, 0.0), name=NASTY), make_camera((2.0, -4.0, 1.0), name="b")]
    training = TrainingViews.of(scene, views)
    renderer = Renderer.of(scene, training, "classic", rasterizer="eager")
    for i, view in enumerate(views):
        write_png(folder / f"{i}.png", renderer(view).rgb * 0.9 + 0.05)
        views[i] = replace(view, photo=folder / f"{i}.png")
    report = evaluate(
        scene,
        CameraSet(tuple(views), tuple(views), notes=(NASTY,)),
        recipe=("classic", "auto"),
        scale=(1.0, 0.5, 2.0),
        background="black",
        rasterizer="eager",
        output=folder,
        report=True,
        name=f"scene {NASTY}",
    )
    return folder, report, coverage(scene, training, report.scales)


class Tags(HTMLParser):
    """Every tag with its attributes."""

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))


def test_the_page_refers_to_nothing_outside_itself(written):
    text = (written[0] / "report.html").read_text()
    for tag, attributes in Tags(text).tags:
        for name in ("src", "href", "xlink:href", "action", "data"):
            value = attributes.get(name) or "#"
            assert value.startswith(("#", "data:")), (tag, name, value)
    assert not re.search(r"@import|url\((?!#)", text)
    assert "default-src 'none'" in text


def test_every_name_is_escaped_and_the_best_is_bold(written):
    text = (written[0] / "report.html").read_text()
    assert "<script>alert" not in text
    assert "&lt;/script&gt;&lt;script&gt;alert(&#39;x&#39;)" in text
    assert [tag for tag, _ in Tags(text).tags].count("script") == 2  # its data and its own
    rows = re.findall(r"<tr( class=\"ceiling\")?><th scope=\"row\">(.*?)</th>(.*?)</tr>", text)
    assert {bool(ceiling) for ceiling, _, cells in rows if '<td class="best">' in cells} == {False}
    assert any(ceiling for ceiling, _, _ in rows)


def test_plots_are_files_too_and_do_not_change(written):
    folder, report, found = written
    names = ["psnr", "ssim", "seconds", "evaluations", "sampling-bounds"]
    for plot, name in zip(plots(report, found), names, strict=True):
        assert (folder / "plots" / f"{name}.svg").read_text() == plot.svg()
        assert min(image_size(folder / "plots" / f"{name}.png")) > 300
        assert "currentColor" in plot.inline_svg()


# ------------------------------------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium")
    with api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser, written):
    """A function that opens the page in a window of some size and scheme; nothing may have gone wrong in it."""
    troubles, contexts, asked = [], [], []

    def open_page(width=1280, height=900, scheme="light"):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=scheme)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: troubles.append(message.text))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto((written[0] / "report.html").as_uri())
        page.wait_for_selector("#compare[data-shown]")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert troubles == []
    assert all(url.startswith(("file:", "data:")) for url in asked)


def data(page, name: str) -> str:
    return page.get_attribute("#compare", f"data-{name}")


def pixel(page, x: float, y: float) -> list[int]:
    """A colour of the viewer, at a share of its width and height."""
    shot = np.frombuffer(page.locator("#canvas").screenshot(), np.uint8)
    image = cv2.imdecode(shot, cv2.IMREAD_COLOR)[..., ::-1]
    return image[int(y * image.shape[0]), int(x * image.shape[1])].tolist()


def test_the_slider_works_by_mouse_and_by_keyboard(opened):
    page = opened()
    box = page.locator("#canvas").bounding_box()
    assert data(page, "split") == "0.500"
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.2, box["y"] + box["height"] / 2)
    page.mouse.up()
    assert float(data(page, "split")) == pytest.approx(0.2, abs=0.01)
    assert float(page.input_value("#split")) == pytest.approx(20, abs=1)
    page.focus("#split")
    page.keyboard.press("ArrowRight")
    assert float(data(page, "split")) == pytest.approx(0.205, abs=0.01)
    page.keyboard.press("End")
    assert data(page, "split") == "1.000"
    page.focus("#canvas")
    page.keyboard.press("[")
    assert data(page, "split") == "0.980"


def test_the_lens_works_by_mouse_and_by_keyboard(opened):
    page = opened()
    assert data(page, "lens") == "off"
    page.focus("#canvas")
    bare = pixel(page, 0.4, 0.3)
    page.keyboard.press("l")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Shift+ArrowDown")
    assert data(page, "lens") == "0.490,0.550,4"
    assert pixel(page, 0.4, 0.3) != bare
    page.keyboard.press("+")
    assert data(page, "lens").endswith(",8")
    box = page.locator("#canvas").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.75, box["y"] + box["height"] * 0.25)
    x, y, zoom = map(float, data(page, "lens").split(","))
    assert (x, y, zoom) == (pytest.approx(0.75, abs=0.01), pytest.approx(0.25, abs=0.01), 8)
    page.click("#stronger")
    assert data(page, "lens").endswith(",16")
    page.focus("#canvas")
    page.keyboard.press("Escape")
    assert data(page, "lens") == "off"


def test_view_scale_sides_and_errors_can_be_chosen(opened):
    page = opened()
    assert data(page, "shown") == f"{NASTY}|2×|classic|auto|image"
    page.locator("#scales input").nth(1).check(force=True)
    page.select_option("#left", "truth")
    page.select_option("#view", "b")
    page.wait_for_selector('#compare[data-shown="b|1/2|truth|auto|image"]')
    assert page.locator("#left-tag").text_content() == "photograph"
    assert re.fullmatch(r"auto · \d\d\.\d\d dB", page.locator("#right-tag").text_content())
    page.check("input[value=error]", force=True)
    page.wait_for_selector("#error-scale", state="visible")
    assert pixel(page, 0.1, 0.5) == [0, 0, 4]  # the truth has no error
    page.focus("#split")
    page.keyboard.press("Home")
    assert pixel(page, 0.1, 0.5) != [0, 0, 4]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_is_readable_on_a_phone_in_light_and_dark(opened, scheme):
    page = opened(390, 844, scheme)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    small = page.evaluate(
        "[...document.querySelectorAll('p, td, th, dd, dt, label, select, a, figcaption')]"
        ".filter(e => e.offsetParent && parseFloat(getComputedStyle(e).fontSize) < 12).length"
    )
    assert small == 0
    colours = page.evaluate(
        "['backgroundColor', 'color'].map(k => getComputedStyle(document.body)[k].match(/\\d+/g).map(Number))"
    )
    paper, ink = (_luminance(colour) for colour in colours)
    assert (paper > ink) == (scheme == "light")
    assert (max(paper, ink) + 0.05) / (min(paper, ink) + 0.05) > 7  # WCAG's AAA


def _luminance(colour: list[int]) -> float:
    linear = [((c / 255 + 0.055) / 1.055) ** 2.4 if c > 10 else c / 255 / 12.92 for c in colour[:3]]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
