"""The live page, driven as a person would in a real browser."""

import json
import math
import shlex
from base64 import b64decode, b64encode
from contextlib import ExitStack
from itertools import combinations
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import torch
from aaplug_cli.main import main

from aaplug import Renderer, read_camera_path, read_image, serving, write_scene
from aaplug.core.cameras import Camera, CameraSet, centred
from aaplug.core.imaging import quantised
from aaplug.evaluation.metrics import psnr
from tests.conftest import click, drag, make_camera, make_scene, place
from tests.test_view import decoded, with_photograph

SEEN = "#picture"
USUAL = {"color_scheme": "light", "bypass_csp": True}  # playwright's waiting evaluates strings
ASKED = {}  # of each page, its last request
WIDTH, HEIGHT = 900, 500  # of a window, in px
# Gathers what a screen reader is told: the texts that change where the page says that it announces changes.
ANNOUNCED = """() => {
  window.announced = [];
  for (const region of document.querySelectorAll("[role=status], [role=alert], output:not([aria-live=off])"))
    new MutationObserver(() => announced.push(region.textContent)).observe(region, {childList: true, subtree: true});
}"""


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A scene and its cameras, of which the first has a photograph."""
    scene, eyes = make_scene(200), [(0.0, -4.0, 0.0), (2.0, -4.0, 1.0), (-2.0, -4.0, 1.0)]
    views = [make_camera(eye, name=f"<i>{i}").scaled(4.0) for i, eye in enumerate(eyes)]
    return scene, with_photograph(scene, views, tmp_path_factory.mktemp("photos"))


@pytest.fixture(scope="module")
def address(seen):
    with serving(*seen, port=0, words=("scene.ply", "--cameras", "a b")) as address:
        yield address


@pytest.fixture(scope="module")
def window(browser):
    """A window for one page after the other; and the address of the first camera at the training size, once known."""
    return browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, **USUAL), []


@pytest.fixture
def opened(browser, window, address):
    """A function that opens the page in a window of some size; nothing may have gone wrong in it."""
    troubles = []
    with ExitStack() as contexts:

        def open_page(where=address, as_opened=False, size=(WIDTH, HEIGHT), **other):
            context, known = window
            usual = where == address and size == (WIDTH, HEIGHT) and not other
            if not usual:
                viewport = {"width": size[0], "height": size[1]}
                context = browser.new_context(viewport=viewport, **USUAL | other)
                contexts.callback(context.close)
            page = context.new_page()
            contexts.callback(page.close)
            page.on("websocket", lambda socket: socket.on("framesent", lambda text: remember(page, text)))
            page.on("console", lambda message: troubles.append(message.text))
            page.on("pageerror", lambda error: troubles.append(str(error)))
            page.goto(known[0] if known and usual and not as_opened else where)
            at_rest(page)
            if not as_opened and not (known and usual):
                page.select_option("#view", "0")
                page.keyboard.press("4")
                at_rest(page, at="0", scale="1")
                if usual:
                    state(page)
                    known.append(page.url)
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
    """What the address holds, once it is of the picture: it follows the camera some time later."""
    script = f"""(pose) => {{
      const told = JSON.parse(decodeURIComponent(location.hash.slice(1)) || '{{}}');
      const {{scale}} = document.querySelector('{SEEN}').dataset;
      return String(told.pose) === String(pose) && String(told.scale) === scale;
    }}"""
    page.wait_for_function(script, arg=ASKED[page]["pose"])
    return json.loads(unquote(urlsplit(page.url).fragment))


def remember(page, message: str | bytes):
    """Keep what a page asked for last; bytes are parts of a dropped file."""
    if isinstance(message, str) and "see" in (asked := json.loads(message)):
        ASKED[page] = asked["see"]


def camera_of(page) -> Camera:
    """The camera of the picture, as the page asked for it."""
    asked = ASKED[page]
    pose = torch.tensor(asked["pose"], dtype=torch.float64).view(4, 4)
    return centred("seen", (asked["width"], asked["height"]), asked["focal"], pose)


def image(page, selector=SEEN) -> torch.Tensor:
    """The pixels of a canvas themselves."""
    url = page.evaluate("(s) => document.querySelector(s).toDataURL()", selector)
    return decoded(b64decode(url.partition(",")[2]))


def groups_of_views(page) -> list[str]:
    return page.evaluate("[...document.querySelectorAll('#view optgroup')].map((group) => group.label)")


def says(page, script: str):
    """Until what the page says of itself is so."""
    page.wait_for_function(f"(({{dataset}}) => {script})(document.querySelector('{SEEN}'))")


def test_a_streamed_picture_is_the_library_s_own(opened, seen):
    page = opened()
    drag(page, (0.2, 0.5), (0.4, 0.6))
    page.keyboard.press("2")  # 1/4
    page.keyboard.press("f")
    at_rest(page, at="", split="1.000")
    camera = camera_of(page)
    for recipe, flipped in (("classic", "0.000"), ("auto", "1.000")):
        expected = Renderer.of(*seen, recipe, quality="best")(camera).rgb
        enlarged = image(page).permute(2, 0, 1)[None]
        small = torch.nn.functional.interpolate(enlarged, camera.hw, mode="nearest-exact")[0].permute(1, 2, 0)
        inside = slice(4, camera.width - 4)  # the divider stands at an edge
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
    page.keyboard.press("m")
    at_rest(page, split="0.500")
    assert page.inner_text("#name-0") == "classic"
    assert page.inner_text("#name-1") == "auto · best"
    page.select_option("#recipe-0", "mip")
    at_rest(page)
    assert page.inner_text("#name-0") == "mip"


def test_the_camera_turns_moves_and_comes_nearer(opened):
    page = opened()
    poses = [ASKED[page]["pose"]]
    for act in (
        lambda: drag(page, (0.2, 0.5), (0.3, 0.5)),
        lambda: drag(page, (0.2, 0.5), (0.3, 0.5), "right"),
        lambda: page.mouse.wheel(0, -200),
        lambda: page.keyboard.press("ArrowUp"),
        lambda: page.keyboard.press("s"),
        lambda: page.keyboard.press("d"),
    ):
        act()
        at_rest(page, at="", split="0.500")
        poses.append(ASKED[page]["pose"])
    assert len({tuple(pose) for pose in poses}) == len(poses)


def test_it_opens_where_both_sides_differ_most_and_says_what_to_look_at(opened, seen):
    page = opened(as_opened=True)
    opening = data(page, "at"), data(page, "scale")
    apart = {}
    for index, view in enumerate(seen[1].train):
        for scale in (0.125, 0.25, 0.5):
            images = [
                quantised(Renderer.of(*seen, recipe, quality="best")(view.scaled(scale)).rgb)
                for recipe in ("classic", "auto")
            ]
            apart[str(index), str(scale)] = psnr(*images) or math.inf
    of_first = min((place for place in apart if place[0] == "0"), key=apart.__getitem__)
    assert opening == min((place for place in apart if place[1] == of_first[1]), key=apart.__getitem__)
    assert f"{apart[opening]:.1f} dB" in page.inner_text("#hint")
    page.keyboard.press("4")
    at_rest(page, scale="1")
    assert not page.locator("#hint").is_visible()
    page.keyboard.press("Home")
    at_rest(page, at=opening[0], scale=opening[1])
    assert page.locator("#hint").is_visible()


def test_a_double_click_sets_the_point_to_turn_about(opened):
    page = opened()
    before = camera_of(page)
    x, y = 0.4, 0.55
    page.mouse.dblclick(*place(page, x, y))
    at_rest(page, at="", split="0.500")
    after = camera_of(page)
    depth = state(page)["depth"]
    assert 1 < depth < 8
    slopes = (x - 0.5) * before.width / before.fx, (y - 0.5) * before.height / before.fy
    point = before.cam_from_world.inverse() @ torch.tensor([slopes[0] * depth, slopes[1] * depth, depth, 1.0]).double()
    drag(page, (0.2, 0.5), (0.4, 0.6))
    at_rest(page, at="")
    for camera in (after, camera_of(page)):
        [middle], _ = camera.project(point[None, :3])
        torch.testing.assert_close(middle, torch.tensor([after.width, after.height]).double() / 2, atol=2.0, rtol=0)


def test_the_background_is_chosen_and_forgotten_and_full_screen_goes_on_and_off(opened):
    page = opened()
    before = image(page)[2, 2]
    page.fill("#background", "#ff8000")
    at_rest(page, at="0")
    corner = image(page)[2, 2]
    torch.testing.assert_close(corner, torch.tensor([1.0, 128 / 255, 0.0]), atol=2 / 255, rtol=0)
    page.click("#asTrained")
    at_rest(page, at="0")
    assert torch.equal(image(page)[2, 2], before)
    page.click("#full")
    page.wait_for_function("document.fullscreenElement !== null")
    page.keyboard.press("g")
    page.wait_for_function("document.fullscreenElement === null")
    page.add_init_script("delete Document.prototype.fullscreenEnabled")  # as on an iPhone
    page.reload()
    at_rest(page)
    assert not page.locator("#full").is_visible()
    page.keyboard.press("g")
    assert page.evaluate("document.fullscreenElement") is None


def test_a_dropped_scene_is_opened_for_this_page_alone(opened, seen, tmp_path):
    one, two = opened(as_opened=True), opened(as_opened=True)
    drop = """([name, text]) => {
      const data = new DataTransfer();
      data.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
      document.querySelector('#stage').dispatchEvent(new DragEvent('drop', {dataTransfer: data, bubbles: true}));
    }"""
    name = "other ☃'s.ply"
    write_scene(tmp_path / name, make_scene(70))
    other = [name, b64encode((tmp_path / name).read_bytes()).decode()]
    one.evaluate(drop, ["bad.ply", b64encode(b"no scene").decode()])
    one.locator("#said", has_text="bad.ply").wait_for()
    record = one.locator("#record")
    click(record)
    one.locator("#path", has_text="(").wait_for()
    one.evaluate(drop, other)
    one.locator("#said", has_text=f"opened {name}").wait_for()
    at_rest(one)
    assert one.inner_text("#facts").startswith("70 Gaussians")
    assert groups_of_views(one) == ["orbit", "assumed training"]
    assert not record.is_checked()
    assert one.inner_text("#path") == "Save path"  # that of the other scene is forgotten
    assert one.locator("#path").is_disabled()
    assert two.inner_text("#facts").startswith("200 Gaussians")
    one.select_option("#view", "0")
    at_rest(one, at="0")
    assert state(one)["pose"] != state(two)["pose"]
    one.reload()
    at_rest(one)
    assert state(one)["pose"] == state(two)["pose"]  # the server's scene, without the camera of the other
    narrow = (make_camera((0.0, -400.0, 0.0), fov=0.01),)
    with serving(tmp_path / name, CameraSet(narrow, narrow), port=0) as address:
        three = opened(where=address, as_opened=True)
        assert camera_of(three).height <= 64 * float(data(three, "scale"))  # all of so narrow a view, and no more
        three.evaluate(drop, other)
        three.locator("#said", has_text=f"opened {name}").wait_for()  # of the same name and count, but without cameras
        assert "training rate assumed" in three.inner_text("#facts")
        three.close()


def test_a_refusal_is_not_acknowledged(opened):
    """The server counts pictures alone, so that a page that acknowledges more would be sent more than it can take."""
    page = opened()
    page.evaluate("""() => {
      window.told = 0;
      const send = WebSocket.prototype.send;
      WebSocket.prototype.send = function (text) {
        window.told += text.includes('"shown"');
        send.call(this, text);
      };
    }""")
    page.fill("#width", "100000")
    for _ in range(3):
        page.click("#still")
        page.wait_for_timeout(200)
    assert page.evaluate("window.told") == 0
    page.keyboard.press("1")
    at_rest(page, scale="0.125")
    assert page.evaluate("window.told") > 0


def test_the_scale_sets_the_size_in_pixels(opened, seen):
    page = opened()
    click(page.locator("#scales input").nth(2))  # 1/2
    at_rest(page, scale="0.5")
    assert page.get_attribute("#scale", "aria-valuetext") == "1/2"
    camera = camera_of(page)
    assert camera.focal == 0.5 * seen[1].train[0].focal
    assert camera.height == pytest.approx(2 * camera.focal * math.tan(math.radians(state(page)["fov"] / 2)), abs=1)
    assert page.locator(SEEN).bounding_box()["height"] == pytest.approx(500, abs=2)
    click(page.locator("input[name=enlarge]").nth(1))
    page.wait_for_function(f"document.querySelector('{SEEN}').width === {camera.width}")
    page.set_viewport_size({"width": 1000, "height": 420})
    says(page, f"dataset.size !== '{camera.width}x{camera.height}'")


def test_the_lens_shows_single_pixels_of_both_sides(opened):
    page = opened()
    page.keyboard.press("1")
    at_rest(page, scale="0.125")
    page.keyboard.press("l")
    says(page, "dataset.lens !== 'off'")
    assert page.locator("#crops canvas").first.evaluate("crop => crop.width") > 50, "drawn before the pointer moves"
    page.mouse.move(*place(page, 0.4, 0.5))
    says(page, "dataset.lens.startsWith('0.4')")
    crops = [image(page, f"#crops figure:nth-child({i}) canvas") for i in (1, 2)]
    assert all(len(torch.unique(crop.flatten(0, 1), dim=0)) < 150 for crop in crops)  # a few large pixels
    page.keyboard.press("+")
    says(page, "dataset.lens.endsWith(',16')")
    page.keyboard.press("Escape")
    page.wait_for_selector(f'{SEEN}[data-lens="off"]')


def test_one_stands_in_cameras_and_sees_their_photographs(opened, seen):
    page = opened()
    assert page.input_value("#view") == "0"
    page.fill("#fade", "1")
    assert page.locator("#names").inner_text().strip() == "photograph"
    values = data(page, "psnr").split(",")
    assert len(values) == 2
    assert f"{float(values[0]):.2f} dB" in page.inner_text("#psnr")
    faded = image(page)
    page.fill("#fade", "0")
    assert page.inner_text("#name-0") == "classic"
    assert not torch.equal(image(page), faded)
    page.keyboard.press("5")  # 2, larger than the photograph
    at_rest(page, scale="2", psnr="")
    assert page.inner_text("#psnr") == "no PSNR above the photograph's own size"
    page.keyboard.press(".")
    at_rest(page, at="1")
    assert page.inner_text("#psnr") == ""
    assert page.locator("#view option:checked").inner_text() == "<i>1"
    assert groups_of_views(page) == ["training"]  # none is held out
    page.keyboard.press("c")
    at_rest(page, at="")
    camera = camera_of(page)
    eyes, depths = camera.project(torch.stack([view.centre for view in seen[1].train]))
    inside = (depths > 0) & (eyes > 0).all(dim=1) & (eyes < torch.tensor([camera.width, camera.height])).all(dim=1)
    assert inside.sum() >= 2, "cameras are in sight as soon as they are shown"
    for _ in range(3):
        page.mouse.move(200, 100)
        page.mouse.wheel(0, 300)
    at_rest(page, at="")
    camera = camera_of(page)
    [[x, y]], _ = camera.project(seen[1].train[2].centre[None])
    page.mouse.click(*place(page, float(x) / camera.width, float(y) / camera.height))
    at_rest(page, at="2")


def test_paints_have_a_legend_and_tell_the_value_under_the_pointer(opened):
    page = opened()
    for name in ("rate", "views", "samples", "cost", "alpha"):
        page.select_option("#paint", name)
        at_rest(page, paint=name)
        assert page.locator("#legend").is_visible()
        page.mouse.move(*place(page, 0.45, 0.5))
        page.wait_for_function("document.querySelector('#legend output').textContent.startsWith('here: ')")
        value = page.inner_text("#legend output").removeprefix("here: ")
        assert float(value) >= 0
        assert len(value.replace(".", "").strip("0")) <= 2  # digits; 254 levels tell no more
    page.select_option("#paint", "")
    at_rest(page, paint="")
    assert not page.locator("#legend").is_visible()


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
    end = camera_of(page).cam_from_world
    torch.testing.assert_close(path.cameras[-1].cam_from_world, end, atol=1e-6, rtol=0)
    page.fill("#width", "64")
    page.fill("#height", "48")
    with page.expect_download() as download:
        page.click("#still")
    download.value.save_as(tmp_path / "still.png")
    assert read_image(tmp_path / "still.png").shape == (48, 64, 3)
    page.evaluate(ANNOUNCED)
    page.keyboard.press("ArrowRight")
    at_rest(page)
    page.fill("#width", "100000")
    page.click("#still")
    page.locator("#said", has_text="width should be a whole number of px from 1 to 8192, not 100000").wait_for()
    begun, refused = page.evaluate("announced")  # no figures of the frames before
    assert begun == "rendering the picture"
    assert "width should be a whole number of px from 1 to 8192, not 100000" in refused
    page.fill("#width", "abc")
    page.click("#still")
    page.locator("#said", has_text="width should be a number, not 'abc'").wait_for()
    page.evaluate("delete Navigator.prototype.clipboard")  # as at the address of another machine, without https
    page.click("#command")
    page.locator("#said", has_text="where view.json is saved, run: aaplug render").wait_for()


@pytest.mark.parametrize("at", ["0", ""])
def test_the_copied_command_draws_what_was_seen(opened, cli, at):
    name = "it's a “$scene`.ply"
    Path("scene.ply").rename(name)
    words = (name, "--cameras", ".")
    with serving(name, ".", port=0, words=words) as where:
        page = opened(where, size=(1003, HEIGHT), permissions=["clipboard-read", "clipboard-write"])
        page.keyboard.press("3")  # 1/2
        page.fill("#background", "#204060")
        if not at:
            drag(page, (0.2, 0.5), (0.4, 0.6))
        page.keyboard.press("f")
        page.keyboard.press("f")
        at_rest(page, at=at, scale="0.5", split="0.000")
        with page.expect_download() as download:
            page.click("#command")
        download.value.save_as("view.json")
        page.locator("#said", has_text="copied").wait_for()
        command = page.evaluate("navigator.clipboard.readText()")
        size, shown = tuple(map(int, data(page, "size").split("x"))), image(page)
    assert len(command) < 150
    program, *rest = shlex.split(command)
    assert program == "aaplug"
    with pytest.raises(SystemExit, match="0"):
        main(rest)
    drawn = read_image("view.png")
    assert (drawn.shape[1], drawn.shape[0]) == size
    small = torch.nn.functional.interpolate(shown.permute(2, 0, 1)[None], drawn.shape[:2], mode="nearest-exact")[0]
    inside = slice(4, None)  # the divider stands at an edge
    torch.testing.assert_close(small.permute(1, 2, 0)[:, inside], drawn[:, inside], atol=1.1 / 255, rtol=0)


def test_two_pages_shake_at_once_and_one_may_close(opened):
    one, two = opened(), opened(size=(600, HEIGHT))
    for page in (one, two):
        page.keyboard.press("x")
        page.wait_for_selector(f"{SEEN}[data-stage=moving]")
    marks = [int(data(page, "id")) for page in (one, two)]
    for page, mark in zip((one, two), marks, strict=True):
        says(page, f"dataset.id > {mark + 3}")
    one.close()
    two.keyboard.press("x")
    at_rest(two, at="0")


def test_a_lost_page_finds_its_server_again(opened, seen):
    with serving(*seen, port=0) as first:
        page = opened(where=first)
        drag(page, (0.2, 0.5), (0.3, 0.5))
        at_rest(page, at="")
        pose = ASKED[page]["pose"]
    page.wait_for_selector("#lost:not([hidden])")
    port = int(first.split(":")[2].strip("/"))
    with serving(*seen, port=port):
        page.wait_for_selector("#lost", state="hidden")
        page.keyboard.press("3")
        at_rest(page, at="", scale="0.5")
        assert state(page)["pose"] == pose
        page.reload()
        at_rest(page, at="", scale="0.5")
        assert ASKED[page]["pose"] == pose


@pytest.mark.parametrize(("size", "scheme"), [((375, 667), "dark"), ((820, 1180), "light")])
def test_it_fits_a_phone_and_a_tablet(opened, size, scheme):
    page = opened(size=size, color_scheme=scheme, has_touch=True)
    assert page.evaluate("document.documentElement.scrollWidth") == size[0]
    assert "viewport-fit" not in page.content()  # else a notch would hide what is at the edge
    fields = "[...document.querySelectorAll('select, [inputmode]')]"
    sizes = page.evaluate(f"{fields}.map(e => parseFloat(getComputedStyle(e).fontSize))")
    assert min(sizes) >= 16  # px; an iPhone zooms the page to a smaller field and stays there
    small = page.evaluate(
        "[...document.querySelectorAll('#panel *, #status, #names span')].filter(e => e.offsetParent"
        " && e.childElementCount === 0 && e.textContent.trim()"
        " && parseFloat(getComputedStyle(e).fontSize) < 10).length"
    )
    assert small == 0
    assert page.locator(SEEN).bounding_box()["height"] > 200
    for key in ("Home", "l"):
        page.keyboard.press(key)
    page.select_option("#paint", "cost")
    at_rest(page, paint="cost")
    page.fill("#width", "100000")
    page.click("#still")
    page.wait_for_selector("#status[data-stage=problem]")  # it is long
    over = [page.locator(name) for name in ("#names", "#crops", "#legend", "#hint", "#status")]
    boxes = [box for each in over if (box := each.bounding_box())]
    for one, other in combinations(boxes, 2):
        apart = [
            one[at] + one[side] <= other[at] or other[at] + other[side] <= one[at]
            for at, side in (("x", "width"), ("y", "height"))
        ]
        assert any(apart), (one, other)
    page.keyboard.press("h")
    assert page.get_by_role("button", name="Controls", exact=True).get_attribute("aria-expanded") == "false"
    page.wait_for_function(f"document.querySelector('#stage').clientHeight === {size[1]}")
    assert decoded(page.screenshot()).std() > 1 / 255
