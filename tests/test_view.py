"""What the live view draws: pictures in steps, at rest the library's own, for several pages in turn."""

import json
import struct
import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from aaplug.core.cameras import CameraSet
from aaplug.core.imaging import quantised
from aaplug.core.pyramids import Pyramid
from aaplug.evaluation.metrics import psnr
from aaplug.io.images import write_png
from aaplug.live import pictures
from aaplug.live.messages import See, Side
from aaplug.live.paints import PAINTS
from aaplug.live.pictures import Pictures
from aaplug.live.studio import Studio
from aaplug.live.subject import Subject
from aaplug.methods.recipe import LevelChoice
from aaplug.rendering.renderer import Renderer
from aaplug.rendering.strips import strips
from tests.conftest import make_camera, make_scene
from tests.test_cli import cli, dataset  # noqa: F401  (fixtures)

SIDES = (Side("classic", "best"), Side("auto", "best"))
RECIPES = ("classic", "auto", "mip")


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A scene and its cameras; the first has a photograph."""
    scene = make_scene(200)
    views = [make_camera((0.0, -4.0, 0.0), name="a"), make_camera((2.0, -4.0, 1.0), name="b")]
    views = [camera.as_trained() for camera in views]
    photo = tmp_path_factory.mktemp("photos") / "a.png"
    write_png(photo, Renderer.of(scene, views, "classic", rasterizer="eager")(views[0]).rgb * 0.9)
    views[0] = replace(views[0], photo=photo)
    return scene, CameraSet(tuple(views), tuple(views))


@pytest.fixture
def subject(seen):
    scene, cameras = seen
    return Subject(scene, cameras, Renderer.of(scene, cameras, "matched", rasterizer="eager"), RECIPES, "a scene", ())


def a_wish(subject: Subject, scale=0.5, **other) -> See:
    camera = subject.views[0].scaled(scale)
    pose = tuple(camera.cam_from_world.flatten().tolist())
    return replace(See(1, pose, camera.focal, camera.width, camera.height, 0.5, SIDES, at=0), **other)


def unpacked(found: bytes) -> tuple[dict, list[bytes]]:
    (length,) = struct.unpack_from("<I", found)
    header, at, files = json.loads(found[4 : 4 + length]), 4 + length, []
    for part in header.get("parts", ()):
        files.append(found[at : at + part["bytes"]])
        at += part["bytes"]
    return header, files if "parts" in header else [found[at:]]


def decoded(file: bytes) -> torch.Tensor:
    bgr = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
    return torch.from_numpy(np.ascontiguousarray(bgr[..., ::-1])).float() / 255


def shown(messages) -> tuple[dict, list[torch.Tensor]]:
    """The last header, and both sides as a page has assembled them."""
    sheets, header = [torch.empty(0), torch.empty(0)], {}
    for message in filter(None, messages):
        header, files = unpacked(message)
        width, height = header["size"]
        for part, file in zip(header["parts"], files, strict=True):
            if part["of"] in "01":
                sheet = sheets[int(part["of"])]
                sheet = sheet if sheet.shape[:2] == (height, width) else torch.zeros(height, width, 3)
                left, right = part["span"]
                image = decoded(file)
                scaled = cv2.resize(image.numpy(), (right - left, height))
                sheet[:, left:right] = torch.from_numpy(scaled)
                sheets[int(part["of"])] = sheet
    return header, sheets


# ----------------------------------------------------------------------------------------------------------- drawing


def finished(steps):
    """What a generator returns, and how often it yielded."""
    taken = 0
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value, taken
        taken += 1


@pytest.mark.parametrize(("recipe", "scale"), [("classic", 1.0), ("auto", 0.5), ("auto", 0.125)])
def test_strips_are_the_picture(seen, recipe, scale, monkeypatch):
    monkeypatch.setattr("aaplug.rendering.strips.SAMPLES", 1000)
    renderer = Renderer.of(*seen, recipe, quality="best", rasterizer="eager")
    camera = seen[1].train[0].scaled(scale)
    whole = renderer(camera)
    middle = camera.width // 3
    for columns in (None, (0, middle), (middle, camera.width)):
        steps = strips(renderer, camera, renderer.samples(camera), columns)
        drawn, taken = finished(steps)
        for found, expected in zip(drawn, whole, strict=True):
            torch.testing.assert_close(found, expected[:, slice(*(columns or (None,)))], atol=2e-5, rtol=0)
        assert taken > 1 or scale < 0.5


def test_strips_draw_the_levels_of_the_picture():
    scenes = [make_scene(count) for count in (200, 150, 20)]
    levels = Pyramid.of(scenes, [torch.zeros(len(scene), dtype=torch.int64) for scene in scenes])
    camera = make_camera((0.0, -4.0, 0.0), (160, 120))
    renderer = Renderer.of(levels, [camera], rasterizer="eager")
    renderer = replace(renderer, recipe=replace(renderer.recipe, levels=LevelChoice()))
    view = camera.scaled(1 / 8)
    assert renderer.coarsening(*renderer.sampled(view)) > 0
    drawn, _ = finished(strips(renderer, view, renderer.samples(view)))
    torch.testing.assert_close(drawn.rgb, renderer(view).rgb, atol=2e-5, rtol=0)


@pytest.mark.parametrize("at", [0, None])
def test_at_rest_a_page_has_the_library_s_own_pictures(subject, at):
    wish = a_wish(subject, at=at)
    header, sheets = shown(Pictures(subject).steps(wish))
    assert header["stage"] == "done"
    camera = subject.camera(wish)
    for side, sheet in zip(SIDES, sheets, strict=True):
        how = {"quality": side.quality, "rasterizer": "eager"}
        expected = Renderer.of(subject.scene, subject.cameras, side.recipe, **how)(camera).rgb
        assert float((sheet - quantised(expected)).abs().max()) < 1.1 / 255


def test_a_large_picture_is_sent_as_jpeg_above_40_db(subject, monkeypatch):
    monkeypatch.setattr(pictures, "LOSSLESS", 0)
    wish = a_wish(subject, scale=1.0)
    messages = list(Pictures(subject).steps(wish))
    assert unpacked(messages[-1])[0]["stage"] == "done"
    _, sheets = shown(messages)
    for side, sheet in zip(SIDES, sheets, strict=True):
        expected = subject.renderer(side)(subject.camera(wish)).rgb
        assert 40 < psnr(sheet, quantised(expected)) < 80


def test_a_moving_camera_gets_one_quick_picture_of_what_is_visible(subject, monkeypatch):
    monkeypatch.setattr(pictures, "UNIT", (2000, 400_000))
    moving = Pictures(subject)
    wish = a_wish(subject, scale=2.0, split=0.25, moving=True)
    [message] = moving.steps(wish)
    header, files = unpacked(message)
    assert header["stage"] == "moving"
    assert [part["span"] for part in header["parts"]] == [[0, wish.width // 4], [wish.width // 4, wish.width]]
    assert header["scale"] < 1
    assert decoded(files[1]).shape[1] < wish.width * 0.75
    resting = list(moving.steps(replace(wish, moving=False)))
    assert "moving" not in {unpacked(m)[0]["stage"] for m in resting if m}  # it has that one


def test_the_effort_falls_with_slow_frames_and_grows_where_it_was_short():
    assert pictures._adapted(1.0, 2 * pictures.FRAME, limited=True) == pytest.approx(0.6)
    assert pictures._adapted(1.0, pictures.FRAME / 2, limited=True) > 1
    assert pictures._adapted(1.0, pictures.FRAME / 2, limited=False) == 1
    assert pictures._adapted(1 / 16, 9.0, limited=True) == 1 / 16


def test_what_is_done_is_not_drawn_again(subject):
    drawing = Pictures(subject)
    list(drawing.steps(a_wish(subject)))
    messages = [unpacked(m)[0] for m in drawing.steps(a_wish(subject, id=2, paint="alpha")) if m]
    assert [header["stage"] for header in messages] == ["done"]
    assert [part["of"] for part in messages[0]["parts"]] == ["paint"]


def test_the_photograph_has_the_figures_of_an_evaluation(subject):
    header, _ = shown(Pictures(subject).steps(a_wish(subject, scale=0.5, photo=True)))
    [own] = [part for part in header["parts"] if part["of"] == "photo"]
    view = subject.views[0]
    expected = []
    for side in SIDES:
        image = quantised(subject.renderer(side)(view.scaled(0.5)).rgb)
        photo = decoded(view.photo.read_bytes())
        small = torch.nn.functional.avg_pool2d(photo.permute(2, 0, 1), 2).permute(1, 2, 0)
        expected.append(psnr(image, small))
    assert header["psnr"] == pytest.approx(expected, abs=0.02)
    assert header["whole"]
    assert own["span"] == [0, view.width // 2]


def test_a_view_in_a_larger_window_keeps_its_pixels(subject):
    wish = a_wish(subject, scale=0.5)
    wide = replace(wish, width=wish.width + 31, height=wish.height + 8)
    left, top, width, height = subject.frame(wide)
    assert (left, top, width, height) == (15, 4, wish.width, wish.height)
    renderer = subject.renderer(SIDES[0])
    inner = renderer(subject.camera(wide)).rgb[top : top + height, left : left + width]
    torch.testing.assert_close(inner, renderer(subject.views[0].scaled(0.5)).rgb, atol=0.01, rtol=0)  # but for its edge


@pytest.mark.parametrize("name", PAINTS)
def test_paints_tell_what_they_say(subject, name):
    renderer, wish = subject.renderer(SIDES[1]), a_wish(subject, scale=0.5)
    camera = subject.camera(wish)
    values = PAINTS[name].draw(renderer, camera, 2)
    assert values.shape == camera.hw
    known = values[values.isfinite()]
    if name == "alpha":
        torch.testing.assert_close(
            values, renderer.rasterizer(renderer.splats(camera), camera.hw, (0.0, 0.0, 0.0)).alpha
        )
    elif name == "samples":
        assert set(known.tolist()) == {4.0}
    elif name == "views":
        assert float(known.min()) >= 1
        assert float(known.max()) <= 2.001
    elif name == "rate":  # half of the training size at a training pose
        assert 0.2 < float(known.median()) <= 0.51
    else:
        assert float(known.max()) >= 4
    levels, legend = PAINTS[name](renderer, camera, 2)
    assert 0 <= float(levels.min()) <= float(levels.max()) <= 1
    assert legend["low"] < legend["high"]


def test_a_still_has_the_size_that_was_asked_for(subject):
    wish = a_wish(subject)
    found = [m for m in Pictures(subject).still(wish, pictures.Still(60, 40, 1)) if m]
    header, [file] = unpacked(found[-1])
    assert header["still"] == "auto-60x40.png"
    expected = subject.renderer(SIDES[1])(subject.camera(wish).framed(60, 40)).rgb
    assert float((decoded(file) - quantised(expected)).abs().max()) < 1.1 / 255


# --------------------------------------------------------------------------------------------------------- the studio


def test_a_newer_wish_ends_the_older_one_between_strips(subject, monkeypatch):
    monkeypatch.setattr("aaplug.rendering.strips.SAMPLES", 200)
    studio, sent = Studio(subject), []
    page = studio.enter(sent.append)
    studio.tell(page, a_wish(subject, id=1))
    for _ in range(3):
        page.step()
    assert page.steps is not None
    studio.tell(page, a_wish(subject, id=2, scale=0.25))
    messages = [message for _ in range(200) if (message := page.step() if page.busy else None)]
    assert {unpacked(message)[0]["id"] for message in messages} == {2}


def test_two_pages_take_turns_and_a_slow_one_waits(subject, monkeypatch):
    monkeypatch.setattr("aaplug.rendering.strips.SAMPLES", 200)
    studio = Studio(subject)
    pages = [studio.enter(lambda message: None) for _ in range(2)]
    for page in pages:
        studio.tell(page, a_wish(subject))
    assert [studio._next() for _ in range(4)] == pages * 2
    pages[0].sent = pages[0].shown + 2
    assert [studio._next() for _ in range(2)] == [pages[1]] * 2
    studio.leave(pages[1])
    pages[0].shown += 1
    assert studio._next() is pages[0]


def test_a_picture_that_fails_says_so_and_the_next_one_comes(subject, monkeypatch):
    sent, there = [], threading.Event()

    def keep(message):
        sent.append(unpacked(message)[0])
        there.set()

    with Studio(subject) as studio:
        page = studio.enter(keep)
        with monkeypatch.context() as broken:
            broken.setattr(Pictures, "_preview", lambda *_: (_ for _ in ()).throw(MemoryError()))
            studio.tell(page, a_wish(subject))
            assert there.wait(10)
        assert sent[0] == {"problem": "out of memory"}
        there.clear()
        studio.tell(page, a_wish(subject, id=2))
        assert there.wait(10)
        assert sent[1]["id"] == 2
