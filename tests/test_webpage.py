"""The report: one page that holds everything, escapes every name, and works by mouse and by keyboard in a browser.

And the camera of the pages that open streamed levels.
"""

import math
import re
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from statistics import mean, stdev
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
import torch
from markupsafe import escape

from aaplug import CameraSet, Renderer, TrainingViews, compare, evaluate
from aaplug.evaluation.coverage import coverage
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.report import webpage
from aaplug.evaluation.report.plots import plots
from aaplug.io.images import image_size
from aaplug.io.streamed import STREAMS
from tests.conftest import click, drag, make_camera, make_scene, with_photographs

NASTY = "</script><script>alert('x')</script>&amp;$\\frac$ “r_0”"
PICTURE = "#stage canvas"
LEVELS = "http://levels.example/"
ESCAPED = NASTY.replace("\\", "\\\\")  # in a selector


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of a report of two views with nasty names, the report and the sampling bounds it shows."""
    folder: Path = tmp_path_factory.mktemp("report")
    scene = make_scene(150)
    views = [make_camera((0.0, -4.0, 0.0), name=NASTY), make_camera((2.0, -4.0, 1.0), name="b")]
    training = TrainingViews.of(scene, views)
    look = Renderer.of(scene, training, "classic", rasterizer="eager")
    cameras = replace(with_photographs(look, views, folder, 0.9, 0.05), notes=(NASTY,))
    how = {"recipe": ("classic", "auto"), "scale": (1.0, 0.5, 2.0), "background": "black", "rasterizer": "eager"}
    report = evaluate(scene, cameras, output=folder, report=True, name=f"scene {NASTY}", **how)
    return folder, report, coverage(scene, training, report.scales)


def test_the_page_refers_to_nothing_outside_itself_and_no_two_parts_have_one_id(written):
    text = (written[0] / "report.html").read_text()
    targets = re.findall(r"\s(?:src|href|xlink:href|action|data)=[\"']?([^\"'\s>]*)", text)
    assert {target.partition(":")[0] for target in targets if not target.startswith("#")} == {"data"}
    assert not re.search(r"@import|url\((?!#)", text)
    assert "default-src 'none'" in text
    ids = re.findall(r"<[^>]*\sid=\"([^\"]*)\"", text)
    assert len(ids) == len(set(ids)) > 20


def test_every_name_is_escaped_and_the_best_is_bold(written):
    text = (written[0] / "report.html").read_text()
    assert "<script>alert" not in text
    assert "&lt;/script&gt;&lt;script&gt;alert(&#39;x&#39;)" in text
    assert len(re.findall(r"<script\b", text)) == 2  # its data and its own
    rows = re.findall(r"<tr( class=\"ceiling\")?><th scope=\"row\">(.*?)</th>(.*?)</tr>", text)
    assert {bool(ceiling) for ceiling, _, cells in rows if '<span class="best">' in cells} == {False}
    assert any(ceiling for ceiling, _, _ in rows)


def test_plots_are_files_too_and_do_not_change(written):
    folder, report, found = written
    names = ["psnr", "ssim", "evaluations", "sampling-bounds"]
    for plot, name in zip(plots(report, found), names, strict=True):
        assert (folder / "plots" / f"{name}.svg").read_text() == plot.svg()
        assert min(image_size(folder / "plots" / f"{name}.png")) > 300
        assert "currentColor" in plot.inline_svg()
    assert not (folder / "plots" / "seconds.svg").exists()  # a curve of times would draw noise


def axes_of(report, found, measurements):
    return plots(replace(report, measurements=tuple(measurements)), found)[0].draw("black").axes[0]


def test_curves_of_many_recipes_differ_in_colour_or_marker(written):
    _, report, found = written
    axes = axes_of(
        report, found, [replace(m, recipe=f"{m.recipe} {i}") for i in range(12) for m in report.measurements]
    )
    looks = {(line.get_color(), line.get_marker()) for line in axes.lines}
    assert len(looks) == len(axes.lines) == 36


def test_the_legend_names_each_curve_in_the_width_of_the_plot(written):
    _, report, found = written
    names = {"classic": "_" + "x" * 300 + "_1", "auto": "_" + "x" * 300 + "_2"}
    axes = axes_of(report, found, [replace(m, recipe=names.get(m.recipe, m.recipe)) for m in report.measurements])
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert [text[-2:] for text in texts[:2]] == ["_1", "_2"]
    assert len(texts) == len(axes.lines)
    assert max(map(len, texts)) <= 60


def test_tables_show_the_spread_and_the_worst_view_and_times_their_quartiles(written):
    folder, report, _ = written

    def cell(title: str, recipe: str, scale: float) -> tuple[str, list[str]]:
        pattern = rf"<h3>{re.escape(title)}</h3>.*?<th scope=\"row\">{recipe}</th>(.*?)</tr>"
        [row] = re.findall(pattern, (folder / "report.html").read_text(), re.DOTALL)
        text = row.split("</td>")[report.scales.index(scale)]
        return text, re.findall(r"\d+\.\d+", re.sub(r"<[^>]*>", " ", text))

    values = {m.view: m.values["PSNR"] for m in report.select("classic", 0.5)}
    worst = min(values, key=values.__getitem__)
    text, figures = cell("PSNR [dB]", "classic", 0.5)
    assert figures == [f"{v:.2f}" for v in (mean(values.values()), stdev(values.values()), values[worst])]
    assert str(escape(worst)) in text
    times = np.quantile([m.seconds for m in report.select("auto", 1.0)], (0.5, 0.25, 0.75))
    assert cell("seconds per view, median", "auto", 1.0)[1] == [f"{time:.3f}" for time in times]


SPREAD = ("Means over the views", "standard deviation", "worst view", "median", "quartiles")


@pytest.mark.parametrize(("views", "said"), [((NASTY, "b"), SPREAD), (("b",), ())])
def test_the_figures_of_a_single_view_have_no_spread(written, views, said):
    folder, report, bounds = written
    measurements = tuple(m for m in report.measurements if m.view in views)
    found = replace(report, measurements=measurements, protocol={**report.protocol, "views": len(views)})
    text = webpage.page("some", found, bounds, [], ImageStore(folder, ()))
    assert [words for words in SPREAD if words in text] == [*said]


@pytest.fixture
def opened(watched, written):
    """A function that opens the page in a window of some size and scheme."""

    def open_page(width=1280, height=900, scheme="light", address="", **other):
        page = watched(width, height, color_scheme=scheme, **other)
        page.goto((written[0] / "report.html").as_uri() + address)
        page.wait_for_selector("#compare[data-shown]")
        return page

    return open_page


def data(page, name: str) -> str:
    return page.get_attribute("#compare", f"data-{name}")


def wait(page, **parts: str):
    """Until the viewer shows that."""
    page.wait_for_selector("#compare" + "".join(f'[data-{name}="{value}"]' for name, value in parts.items()))


def image(page, selector: str) -> np.ndarray:
    shot = np.frombuffer(page.locator(selector).screenshot(), np.uint8)
    return cv2.imdecode(shot, cv2.IMREAD_COLOR)[..., ::-1]


def pixel(page, x: float, y: float, selector=f"{PICTURE} >> nth=0") -> list[int]:
    """A colour of a picture, by default of the first one, at a share of its width and height."""
    found = image(page, selector)
    return found[int(y * found.shape[0]), int(x * found.shape[1])].tolist()


def labels(page, selector="#stage") -> list[str]:
    return page.locator(f"{selector} .labels span").all_text_contents()


def choose(page, *roles: str):
    """Show these, at a scale that has photographs."""
    click(page.locator("#scales input").nth(1))
    page.wait_for_selector("#roles input[value=truth]:enabled", state="attached")
    for box in page.locator("#roles input").all():
        if box.is_checked() != (box.get_attribute("value") in roles):
            click(box)


def test_the_divider_works_by_mouse_and_by_keyboard(opened):
    page = opened()
    assert data(page, "split") == "0.500"
    drag(page, (0.5, 0.5), (0.2, 0.5), on=PICTURE)
    wait(page, split="0.200")
    assert float(page.input_value("#split")) == pytest.approx(20, abs=1)
    page.focus("#split")
    page.keyboard.press("ArrowRight")
    wait(page, split="0.205")
    page.keyboard.press("End")
    wait(page, split="1.000")
    page.focus("#stage")
    page.keyboard.press("[")
    wait(page, split="0.980")


def test_the_lens_works_by_mouse_and_by_keyboard(opened):
    page = opened()
    assert data(page, "lens") == "off"
    page.focus("#stage")
    page.keyboard.press("l")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("Shift+ArrowDown")
    wait(page, lens="0.490,0.550,8")
    page.keyboard.press("+")
    wait(page, lens="0.490,0.550,16")
    box = page.locator(PICTURE).bounding_box()
    page.locator(PICTURE).click(position={"x": box["width"] * 0.75, "y": box["height"] * 0.25})  # once it stands still
    page.wait_for_function("!document.querySelector('#compare').dataset.lens.startsWith('0.49')")
    x, y, zoom = map(float, data(page, "lens").split(","))
    assert (x, y, zoom) == (pytest.approx(0.75, abs=0.01), pytest.approx(0.25, abs=0.01), 16)
    assert data(page, "split") == "0.500"
    page.click("#weaker")
    wait(page, lens=f"{x:.3f},{y:.3f},8")
    page.focus("#stage")
    page.keyboard.press("Escape")
    wait(page, lens="off")


@pytest.mark.parametrize("size", [(1440, 900), (390, 844)])
def test_the_lens_stands_beside_the_picture_and_names_what_it_shows(opened, size):
    page = opened(*size)
    choose(page, "truth", "classic", "auto")
    click(page.locator("#lens"))
    wait(page, lens="0.500,0.500,8")
    assert labels(page, "#crops") == ["photograph", "classic", "auto"]
    pictures, crops = (
        [tile.bounding_box() for tile in page.locator(f"{place} canvas").all()] for place in ("#stage", "#crops")
    )
    for a in pictures:
        for b in crops:
            apart = (a["x"] + a["width"] <= b["x"], b["x"] + b["width"] <= a["x"])
            assert any(apart) or a["y"] + a["height"] <= b["y"]
    width, height = pictures[0]["width"], pictures[0]["height"]
    for share in (0.3, 0.7):  # of the crop, which shows the middle eighth of the picture's height
        away = (share - 0.5) / 8
        shown = pixel(page, share, share, "#crops canvas >> nth=0")
        click(page.locator("#lens"))
        wait(page, lens="off")
        assert shown == pixel(page, 0.5 + away * height / width, 0.5 + away)
        click(page.locator("#lens"))
        wait(page, lens="0.500,0.500,8")


@pytest.mark.parametrize("size", [(1440, 900), (390, 844), (844, 390)])
def test_any_number_of_recipes_stands_side_by_side_and_fits_the_screen(opened, size):
    page = opened(*size)
    roles = ("truth", "training size, resampled", "classic", "auto")
    for count in range(len(roles), 0, -1):
        choose(page, *roles[-count:])
        page.wait_for_function(f"document.querySelectorAll('#stage canvas').length === {1 if count == 2 else count}")
        assert page.locator("#split").is_visible() == (count == 2)
        assert [label.partition(" · ")[0] for label in labels(page)] == ["photograph", *roles[1:]][-count:]
        boxes = [tile.bounding_box() for tile in page.locator(PICTURE).all()]
        assert max(b["y"] + b["height"] for b in boxes) - min(b["y"] for b in boxes) < size[1]
        assert max(b["x"] + b["width"] for b in boxes) <= size[0]
        assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    click(page.locator("#roles input[value=auto]"))  # the last one stays
    page.wait_for_function("document.querySelector('#roles input[value=auto]').checked")
    assert data(page, "shown").endswith("|auto|image")


def test_error_mode_explains_an_empty_side(opened):
    page = opened()
    click(page.locator("input[value=error]"))
    wait(page, shown=f"{ESCAPED}|2×|classic+auto|error")
    assert all("no photograph at this scale" in label for label in labels(page))
    page.select_option("#view", "b")
    choose(page, "truth", "auto")
    wait(page, shown="b|1/2|truth+auto|error")
    left, right = labels(page)
    assert left == "photograph · compared with itself: no error"
    assert re.fullmatch(r"auto · \d\d\.\d\d dB · largest error \d+ of 255", right)
    assert page.locator("#error-scale").is_visible()
    assert pixel(page, 0.1, 0.5) == [0, 0, 4]
    page.focus("#split")
    page.keyboard.press("Home")
    wait(page, split="0.000")
    assert pixel(page, 0.1, 0.5) != [0, 0, 4]


def test_the_address_holds_what_one_sees(opened):
    page = opened()
    before = page.evaluate("history.length")
    assert urlsplit(page.url).fragment == ""
    choose(page, "truth", "auto")
    click(page.locator("input[value=error]"))
    page.focus("#split")
    for _ in range(30):
        page.keyboard.press("ArrowRight")
    click(page.locator("#lens"))
    page.click("#stronger")
    page.wait_for_url("**lens**16")
    found = parse_qs(urlsplit(page.url).fragment)
    assert found == {
        "view": [NASTY], "scale": ["1/2"], "show": ["truth", "auto"], "mode": ["error"], "split": ["0.650"],
        "lens": ["0.500,0.500,16"],
    }  # fmt: skip
    assert page.evaluate("history.length") == before
    again = opened(address="#" + urlsplit(page.url).fragment)
    for name in ("shown", "split", "lens"):
        assert data(again, name) == data(page, name)
    assert labels(again) == labels(page)


def test_an_address_of_a_section_or_of_nonsense_does_no_harm(opened):
    usual = data(opened(), "shown")
    for address in ("#figures", "#view=gone&scale=7&show=x&split=nan&lens=a,b,c&mode=", "#view=%E0%A4%A"):
        page = opened(address=address)
        assert (data(page, "shown"), data(page, "lens"), data(page, "split")) == (usual, "off", "0.500")


def test_long_names_are_whole_on_a_desktop_and_on_paper(watched, tmp_path, plots_drawn_once):
    scenes = {f"a_scene_whose_name_is_as_long_as_{name}.ply": make_scene(150, seed) for seed, name in enumerate("ab")}
    scenes["x" * 200] = make_scene(150, 2)
    views = tuple(make_camera((place, -4.0, 1.0), name=f"view_at_{place}_metres") for place in (0.0, 2.0))
    compare(scenes, CameraSet(views, views), tmp_path, metric="psnr", rasterizer="eager", any_frame=True)
    page = watched()
    page.goto((tmp_path / "report.html").as_uri())
    whole = "[...document.querySelectorAll('.scroll')].every(e => e.scrollWidth <= e.clientWidth)"
    assert page.evaluate(whole)
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 700, "height": 1000})  # of A4 between margins
    assert page.evaluate(whole)
    page.emulate_media(media="screen")
    page.set_viewport_size({"width": 1280, "height": 900})
    choose(page, *list(scenes)[1:])
    page.wait_for_function("document.querySelector('#stage .labels').lastChild.textContent.startsWith('x')")
    assert page.evaluate("document.documentElement.scrollWidth") == 1280
    line, label = (page.locator(f"#stage .labels{part}").bounding_box() for part in ("", " span >> nth=0"))
    assert label["width"] > 0.4 * line["width"]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_is_readable_on_a_phone_in_light_and_dark(opened, scheme):
    page = opened(390, 844, scheme, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    small = page.evaluate(
        "[...document.querySelectorAll('p, td, small, th, dd, dt, label, select, a, .labels')]"
        ".filter(e => e.offsetParent && parseFloat(getComputedStyle(e).fontSize) < 12).length"
    )
    assert small == 0
    assert page.evaluate("getComputedStyle(document.querySelector('select')).fontSize") == "16px"  # or iPhones zoom
    colours = page.evaluate(
        "['backgroundColor', 'color'].map(k => getComputedStyle(document.body)[k].match(/\\d+/g).map(Number))"
    )
    linear = [[((c / 255 + 0.055) / 1.055) ** 2.4 if c > 10 else c / 255 / 12.92 for c in rgb[:3]] for rgb in colours]
    paper, ink = (0.2126 * r + 0.7152 * g + 0.0722 * b for r, g, b in linear)
    assert (paper > ink) == (scheme == "light")
    assert (max(paper, ink) + 0.05) / (min(paper, ink) + 0.05) > 7  # WCAG's AAA


def test_one_sees_what_is_chosen_in_the_colours_of_a_system_with_high_contrast(opened):
    script = "[...document.querySelectorAll('body, #scales span')].map(e => getComputedStyle(e).backgroundColor)"
    *others, chosen = opened(forced_colors="active").evaluate(script)
    assert chosen not in others


@pytest.mark.parametrize("name", STREAMS)
def test_a_browser_leaves_fingers_to_a_page_of_streamed_levels(browser, name):
    """Else it would scroll and zoom the page, and cancel the pointers of the viewer."""
    page = browser.new_page()
    page.set_content(files("aaplug.io.stream_pages").joinpath(f"{name}.html").read_text())
    script = "getComputedStyle(document.body.appendChild(document.createElement('canvas'))).touchAction"
    assert page.evaluate(script) == "none"
    page.close()


def test_a_page_of_streamed_levels_says_why_it_shows_none(browser, tmp_path):
    for name in ("index.html", "problems.js"):
        source = files("aaplug.io.stream_pages").joinpath(name.replace("index", "3dtiles"))
        (tmp_path / name).write_bytes(source.read_bytes())
    page = browser.new_page()
    page.goto((tmp_path / "index.html").as_uri())
    assert "run “python -m http.server” in this folder" in page.locator("p").inner_text()
    page.close()
    page, script = browser.new_page(), (tmp_path / "problems.js").read_text()
    page.set_content(f"<canvas></canvas><script>{script}</script><script src=nowhere:viewer.js></script>")
    assert page.locator("p").inner_text() == "nowhere:viewer.js cannot be read"
    page.close()
    page = browser.new_page()
    body = f"<canvas></canvas><script>{script}</script><script>fetch('part.webp')</script>"
    status = {LEVELS: 200}
    page.route("**", lambda r: r.fulfill(status=status.get(r.request.url, 404), content_type="text/html", body=body))
    page.goto(LEVELS)
    assert page.locator("p").inner_text() == f"{LEVELS}part.webp is not on the server"
    page.close()


def test_a_page_of_streamed_levels_turns_and_zooms_by_mouse_and_fingers(watched):
    """By the camera's place: up to one side of an up that is x, before a canvas twice as high as wide."""
    script = files("aaplug.io.stream_pages").joinpath("orbit.js").read_text()
    eyes = watched().evaluate(
        """async (script) => {
          const { orbit } = await import("data:text/javascript," + encodeURIComponent(script));
          const canvas = document.body.appendChild(document.createElement("canvas"));
          Object.assign(canvas, { width: 100, height: 200, setPointerCapture: () => {} });
          const seen = orbit(canvas, { up: [1, 0, 0], front: [0, 1, 0], centre: [5, 0, 0], radius: 2 });
          const point = (kind, pointerId, clientX, clientY = 0) =>
            canvas.dispatchEvent(new PointerEvent("pointer" + kind, { pointerId, clientX, clientY }));
          const eyes = [seen()];
          point("down", 1, 0), point("move", 1, -100 * Math.PI), point("up", 1, 0), point("move", 1, 7);
          eyes.push(seen());
          point("down", 1, 0), point("down", 2, 10), point("move", 2, 20), point("up", 1, 0), point("up", 2, 0);
          eyes.push(seen());
          canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 1000 * Math.LN2 }));
          return [...eyes, seen()];
        }""",
        script,
    )
    first, turned, pinched, wheeled = (torch.tensor(eye["eye"]) - torch.tensor([5.0, 0.0, 0.0]) for eye in eyes)
    far = 2 / math.sin(math.atan(math.tan(math.pi / 8) / 2))
    torch.testing.assert_close(first, far * torch.tensor([math.sin(0.35), math.cos(0.35), 0.0]))
    torch.testing.assert_close(turned, far * torch.tensor([math.sin(0.35), 0.0, math.cos(0.35)]))
    torch.testing.assert_close(pinched, turned / 2)
    torch.testing.assert_close(wheeled, turned)
    assert all(eye["near"] < far / 100 and eye["far"] > 100 * far for eye in eyes)
