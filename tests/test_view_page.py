"""The live page, driven as a person would in a real browser."""

import json
from base64 import b64decode
from contextlib import ExitStack
from dataclasses import replace
from urllib.parse import unquote, urlsplit

import cv2
import numpy as np
import pytest
import torch

from aaplug.core.cameras import CameraSet
from aaplug.core.imaging import quantised
from aaplug.core.orbits import pinhole
from aaplug.evaluation.metrics import psnr
from aaplug.io.cameras.camera_path import read_camera_path
from aaplug.io.images import read_image, write_png
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.view import serving
from tests.conftest import make_camera, make_scene
from tests.test_webpage import browser  # noqa: F401  (fixture)

SEEN = "#picture"


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A scene and its cameras, of which the first has a photograph."""
    scene, folder = make_scene(200), tmp_path_factory.mktemp("photos")
    eyes = [(0.0, -4.0, 0.0), (2.0, -4.0, 1.0), (-2.0, -4.0, 1.0)]
    views = [make_camera(eye, name=f"<i>{i}") for i, eye in enumerate(eyes)]
    views = [view.scaled(4.0).as_trained() for view in views]
    write_png(folder / "0.png", Renderer.of(scene, views, "classic", rasterizer="eager")(views[0]).rgb * 0.9)
    views[0] = replace(views[0], photo=folder / "0.png")
    return scene, CameraSet(tuple(views), tuple(views))


@pytest.fixture(scope="module")
def address(seen):
    with serving(*seen, port=0, rasterizer="eager", words=("scene.ply", "--cameras", "a b")) as address:
        yield address


@pytest.fixture
def opened(browser, address):  # noqa: F811
    """A function that opens the page in a window of some size; nothing may have gone wrong in it."""
    troubles = []
    with ExitStack() as contexts:

        def open_page(width=900, height=500, scheme="light", where=address, **other):
            how = {"color_scheme": scheme, "bypass_csp": True} | other  # playwright's waiting evaluates strings
            context = browser.new_context(viewport={"width": width, "height": height}, **how)
            contexts.callback(context.close)
            page = context.new_page()
            page.on("console", lambda message: troubles.append(message.text))
            page.on("pageerror", lambda error: troubles.append(str(error)))
            page.goto(where)
            at_rest(page)
            return page

        yield open_page
    known = ("ERR_CONNECTION_REFUSED", "Canvas2D: Multiple readback")  # a lost server, and this file's own reading
    assert [text for text in troubles if not any(words in text for words in known)] == []


def at_rest(page, **parts: str):
    """Until the page rests and shows that: with the newest picture, complete."""
    shows = "Object.entries(parts).every(([name, value]) => seen[name] === value)"
    script = f"""(parts) => {{
      const seen = document.querySelector('{SEEN}').dataset;
      return seen.stage === 'done' && seen.asked === seen.id && {shows};
    }}"""
    page.wait_for_function(script, arg=parts, timeout=60_000)  # a busy machine


def data(page, name: str) -> str:
    return page.get_attribute(SEEN, f"data-{name}")


def state(page) -> dict:
    """What the address holds, once it stays as it is: it follows the camera some time later."""
    page.wait_for_function("location.hash.length > 10")
    before = ""
    while before != page.url:
        before = page.url
        page.wait_for_timeout(400)
    return json.loads(unquote(urlsplit(before).fragment))


def image(page, selector=SEEN) -> torch.Tensor:
    """The pixels of a canvas themselves."""
    url = page.evaluate("(s) => document.querySelector(s).toDataURL()", selector)
    pixels = cv2.imdecode(np.frombuffer(b64decode(url.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    return torch.from_numpy(pixels.astype(np.float32) / 255)


def drag(page, start, end, button="left"):
    box = page.locator(SEEN).bounding_box()
    places = [(box["x"] + x * box["width"], box["y"] + y * box["height"]) for x, y in (start, end)]
    page.mouse.move(*places[0])
    page.mouse.down(button=button)
    page.mouse.move(*places[1], steps=4)
    page.mouse.up(button=button)


def test_a_streamed_picture_is_the_library_s_own(opened, seen):
    page = opened()
    drag(page, (0.2, 0.5), (0.4, 0.6))
    page.keyboard.press("2")  # 1/4
    page.keyboard.press("f")
    at_rest(page, at="", split="1.000")
    width, height = map(int, data(page, "size").split("x"))
    found = state(page)
    scene, cameras = seen
    pose = torch.tensor(found["pose"], dtype=torch.float64).view(4, 4)
    camera = pinhole("seen", (width, height), found["scale"] * cameras.train[0].focal, pose)
    for recipe, flipped in (("classic", "0.000"), ("auto", "1.000")):
        expected = Renderer.of(scene, cameras, recipe, quality="best", rasterizer="eager")(camera).rgb
        shown = image(page).permute(2, 0, 1)[None]
        small = torch.nn.functional.interpolate(shown, (height, width), mode="nearest-exact")[0].permute(1, 2, 0)
        inside = slice(4, width - 4)  # the divider stands at an edge
        decibels = psnr(small[:, inside].contiguous(), quantised(expected)[:, inside].contiguous())
        assert decibels is None or decibels > 40  # None: equal
        page.keyboard.press("f")
        at_rest(page, split=flipped)


def test_its_own_policy_lets_it_work(opened):
    page = opened(bypass_csp=False)
    page.select_option("#paint", "alpha")
    page.wait_for_selector(f"{SEEN}[data-paint=alpha]")
    assert page.evaluate("typeof state") == "undefined"  # nothing of the page's is global


def test_the_divider_works_by_mouse_and_by_keyboard(opened):
    page = opened()
    assert data(page, "split") == "0.500"
    before = data(page, "asked")
    drag(page, (0.5, 0.5), (0.2, 0.5))
    at_rest(page, split="0.200")
    page.keyboard.press("]")
    at_rest(page, split="0.220")
    assert data(page, "asked") == before  # both sides are there; nothing is drawn anew
    page.keyboard.press("d")
    at_rest(page, split="0.500")
    assert page.inner_text("#name-0") == "classic"
    assert page.inner_text("#name-1") == "auto · best"
    page.select_option("#recipe-0", "mip")
    at_rest(page)
    assert page.inner_text("#name-0") == "mip"


def test_the_camera_turns_moves_and_comes_nearer(opened):
    page = opened()
    poses = [state(page)["pose"]]
    for act in (
        lambda: drag(page, (0.2, 0.5), (0.3, 0.5)),
        lambda: drag(page, (0.2, 0.5), (0.3, 0.5), "right"),
        lambda: page.mouse.wheel(0, -200),
        lambda: page.keyboard.press("ArrowUp"),
        lambda: page.keyboard.press("s"),
    ):
        act()
        at_rest(page, at="")
        poses.append(state(page)["pose"])
    assert len({tuple(pose) for pose in poses}) == len(poses)
    page.keyboard.press("Home")
    at_rest(page, at="0")
    assert state(page)["pose"] == poses[0]


def test_the_scale_sets_the_size_in_pixels(opened):
    page = opened()
    page.locator("#scales input").nth(2).check(force=True)  # 1/2
    at_rest(page, scale="0.5")
    width, height = map(int, data(page, "size").split("x"))
    found = state(page)
    focal, half = 0.5 * 4 * make_camera((0.0, -4.0, 0.0)).focal, np.tan(np.radians(found["fov"] / 2))
    assert height == pytest.approx(2 * focal * half, abs=1)
    box = page.locator(SEEN).bounding_box()
    assert box["height"] == pytest.approx(500, abs=2)
    page.locator("input[name=enlarge]").nth(1).check(force=True)
    page.wait_for_function(f"document.querySelector('#picture').width === {width}")
    page.set_viewport_size({"width": 1000, "height": 420})
    page.wait_for_function(f"document.querySelector('{SEEN}').dataset.size !== '{width}x{height}'")


def test_the_lens_shows_single_pixels_of_both_sides(opened):
    page = opened()
    page.keyboard.press("1")
    page.keyboard.press("l")
    at_rest(page, scale="0.125")
    box = page.locator(SEEN).bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.4, box["y"] + box["height"] * 0.5)
    page.wait_for_function("document.querySelector('#picture').dataset.lens.startsWith('0.4')")
    crops = [image(page, f"#crops figure:nth-child({i}) canvas") for i in (1, 2)]
    assert all(len(torch.unique(crop.flatten(0, 1), dim=0)) < 150 for crop in crops)  # a few large pixels
    page.keyboard.press("+")
    page.wait_for_function("document.querySelector('#picture').dataset.lens.endsWith(',16')")
    page.keyboard.press("Escape")
    page.wait_for_selector(f'{SEEN}[data-lens="off"]')


def test_one_stands_in_cameras_and_sees_their_photographs(opened):
    page = opened()
    assert page.input_value("#view") == "0"
    page.fill("#fade", "1")
    values = data(page, "psnr").split(",")
    assert len(values) == 2
    assert f"{float(values[0]):.2f} dB" in page.inner_text("#psnr")
    shown = image(page)
    page.fill("#fade", "0")
    assert not torch.equal(image(page), shown)
    page.keyboard.press(".")
    at_rest(page, at="1")
    assert page.inner_text("#psnr") == ""
    assert page.locator("#view option:checked").inner_text() == "<i>1"
    page.keyboard.press("c")
    for _ in range(3):
        page.mouse.move(200, 100)
        page.mouse.wheel(0, 300)
    at_rest(page, at="")
    box = page.locator(SEEN).bounding_box()
    x, y = projected(make_camera((-2.0, -4.0, 1.0)).centre, state(page), page)
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    at_rest(page, at="2")


def seen_pose(found: dict) -> list[list[float]]:
    return [found["pose"][i : i + 4] for i in range(0, 16, 4)]


def projected(point: torch.Tensor, found: dict, page) -> tuple[float, float]:
    """Where a point is, in shares of the picture."""
    width, height = map(int, data(page, "size").split("x"))
    focal = found["scale"] * 4 * make_camera((0.0, -4.0, 0.0)).focal
    pose = torch.tensor(seen_pose(found), dtype=torch.float64)
    [[x, y]], _ = pinhole("p", (width, height), focal, pose).project(point[None].double())
    return float(x) / width, float(y) / height


def test_paints_have_a_legend_and_tell_the_value_under_the_pointer(opened):
    page = opened()
    for name in ("rate", "views", "samples", "cost", "alpha"):
        page.select_option("#paint", name)
        at_rest(page, paint=name)
        assert page.locator("#legend").is_visible()
        box = page.locator(SEEN).bounding_box()
        page.mouse.move(box["x"] + box["width"] * 0.45, box["y"] + box["height"] * 0.5)
        page.wait_for_function("document.querySelector('#legend output').textContent.startsWith('here: ')")
        assert float(page.inner_text("#legend output").removeprefix("here: ")) >= 0
    page.select_option("#paint", "")
    at_rest(page, paint="")
    assert not page.locator("#legend").is_visible()


def test_shaking_moves_the_picture_and_stops(opened):
    page = opened()
    page.keyboard.press("x")
    page.wait_for_selector(f"{SEEN}[data-stage=moving]")
    first = int(data(page, "id"))
    page.wait_for_function(f"document.querySelector('#picture').dataset.id > {first + 3}")
    page.keyboard.press("x")
    at_rest(page, at="0")


def test_a_path_a_still_and_a_command_are_kept(opened, tmp_path):
    page = opened(permissions=["clipboard-read", "clipboard-write"])
    page.keyboard.press("r")
    drag(page, (0.2, 0.5), (0.4, 0.5))
    at_rest(page, at="")
    kept = "parseInt(document.querySelector('#path').textContent.slice(11))"
    page.wait_for_function(f"{kept} > {page.evaluate(kept)} + 3")  # frames of the end
    page.keyboard.press("r")
    with page.expect_download() as download:
        page.click("#path")
    download.value.save_as(tmp_path / "camera_path.json")
    path = read_camera_path(tmp_path / "camera_path.json")
    assert path.fps == 24
    end = torch.tensor(seen_pose(state(page)), dtype=torch.float64)
    torch.testing.assert_close(path.cameras[-1].cam_from_world, end, atol=1e-6, rtol=0)
    page.fill("#width", "64")
    page.fill("#height", "48")
    with page.expect_download() as download:
        page.click("#still")
    download.value.save_as(tmp_path / "still.png")
    assert read_image(tmp_path / "still.png").shape == (48, 64, 3)
    page.click("#command")
    page.wait_for_function("document.querySelector('#said').textContent.startsWith('copied')")
    words = page.evaluate("navigator.clipboard.readText()")
    assert "aaplug video scene.ply --cameras 'a b' --path camera_path.json" in words
    page.keyboard.press("Home")
    at_rest(page, at="0")
    page.click("#command")
    page.wait_for_function("document.querySelector('#said').textContent.includes('--views')")
    words = page.inner_text("#said")
    assert "aaplug render scene.ply --cameras 'a b' --views '<i>0' --scale" in words
    assert "--recipe auto --quality best" in words
    page.keyboard.press("f")
    at_rest(page, split="1.000")
    page.click("#command")  # of the side that is seen
    page.wait_for_function("document.querySelector('#said').textContent.includes('--recipe classic -o')")
    page.fill("#width", "100000")
    page.click("#still")
    page.wait_for_function("document.querySelector('#said').textContent.startsWith('size: is 100000x48 px')")


def test_two_pages_move_at_once_and_one_may_close(opened):
    one, two = opened(), opened(width=600)
    for page in (one, two):
        page.keyboard.press("x")
    marks = [int(data(page, "id")) for page in (one, two)]
    for page, mark in zip((one, two), marks, strict=True):
        page.wait_for_function(f"document.querySelector('#picture').dataset.id > {mark + 3}")
    one.close()
    two.keyboard.press("x")
    at_rest(two)


def test_a_lost_page_finds_its_server_again(opened, seen):
    with serving(*seen, port=0, rasterizer="eager") as first:
        page = opened(where=first)
        drag(page, (0.2, 0.5), (0.3, 0.5))
        at_rest(page, at="")
        pose = state(page)["pose"]
    page.wait_for_selector("#lost:not([hidden])")
    port = int(first.split(":")[2].strip("/"))
    with serving(*seen, port=port, rasterizer="eager"):
        page.wait_for_selector("#lost", state="hidden")
        page.keyboard.press("3")
        at_rest(page, at="", scale="0.5")
        assert state(page)["pose"] == pose
        page.reload()
        at_rest(page, at="", scale="0.5")
        assert state(page)["pose"] == pose


@pytest.mark.parametrize(("size", "scheme"), [((390, 844), "light"), ((390, 844), "dark"), ((820, 1180), "light")])
def test_it_fits_a_phone_and_a_tablet(opened, size, scheme):
    page = opened(*size, scheme)
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    small = page.evaluate(
        "[...document.querySelectorAll('#panel *, #status, #names span')].filter(e => e.offsetParent"
        " && e.childElementCount === 0 && e.textContent.trim()"
        " && parseFloat(getComputedStyle(e).fontSize) < 10).length"
    )
    assert small == 0
    box = page.locator(SEEN).bounding_box()
    assert box["height"] > 200
    page.keyboard.press("h")
    page.wait_for_function(f"document.querySelector('#stage').clientHeight === {size[1]}")
    shot = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert shot.std() > 1
