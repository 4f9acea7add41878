"""What the live view draws: pictures in steps, at rest the library's own, for several pages in turn."""

import json
import math
import struct
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from aaplug import CameraSet, Pyramid, Renderer, read_image, write_png
from aaplug.core.imaging import average_samples, box_average, quantised
from aaplug.core.lenses import EQUIDISTANT, EQUIRECT, PINHOLE, opencv_lens
from aaplug.evaluation.metrics import psnr
from aaplug.live import pictures
from aaplug.live.messages import PickRequest, PictureRequest, Side, StillRequest
from aaplug.live.overlays import OVERLAYS
from aaplug.live.pictures import Page, Pictures
from aaplug.live.subject import Subject
from aaplug.methods.recipe import LevelChoice
from aaplug.rendering.strips import strips
from tests.conftest import make_camera, make_scene, with_photographs

SIDES = (Side("classic", "best"), Side("auto", "best"))
RECIPES = ("classic", "auto", "mip")


def with_photograph(scene, views, folder) -> CameraSet:
    """The views as trained; the first has a photograph, somewhat darker than the scene."""
    views = [view.as_trained() for view in views]
    look = Renderer.of(scene, views, "classic", rasterizer="eager")
    views[:1] = with_photographs(look, views[:1], folder, 0.9).test
    return CameraSet(tuple(views), tuple(views))


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A scene and its cameras."""
    scene, views = make_scene(200), [make_camera((0.0, -4.0, 0.0), name="a"), make_camera((2.0, -4.0, 1.0), name="b")]
    return scene, with_photograph(scene, views, tmp_path_factory.mktemp("photos"))


@pytest.fixture
def subject(seen):
    scene, cameras = seen
    look = Renderer.of(scene, cameras, "matched", rasterizer="eager")
    return Subject(cameras, look, RECIPES, "a scene", ())


def a_request(subject: Subject, scale=0.5, **other) -> PictureRequest:
    camera = subject.views[0].scaled(scale)
    pose = tuple(camera.cam_from_world.flatten().tolist())
    return replace(PictureRequest(1, pose, camera.focal, camera.width, camera.height, 0.5, SIDES, at=0), **other)


def unpacked(message: bytes) -> tuple[dict, list[bytes]]:
    (length,) = struct.unpack_from("<I", message)
    header, at, files = json.loads(message[4 : 4 + length]), 4 + length, []
    for part in header.get("parts", ()):
        files.append(message[at : at + part["bytes"]])
        at += part["bytes"]
    return header, files if "parts" in header else [message[at:]]


def decoded(file: bytes) -> torch.Tensor:
    bgr = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR)
    return torch.from_numpy(np.ascontiguousarray(bgr[..., ::-1])).float() / 255


def headers(messages) -> list[dict]:
    return [unpacked(message)[0] for message in filter(None, messages)]


def assembled(messages) -> tuple[dict, list[torch.Tensor]]:
    """The last header, and both sides as a page has assembled them."""
    messages = list(filter(None, messages))
    header = headers(messages)[-1]
    width, height = header["size"]
    sheets = [torch.zeros(height, width, 3) for _ in SIDES]
    for message in messages:
        moment, files = unpacked(message)
        for part, file in zip(moment["parts"], files, strict=True):
            if part["of"] in "01":
                left, right = part["span"]
                image = cv2.resize(decoded(file).numpy(), (right - left, height))
                sheets[int(part["of"])][:, left:right] = torch.from_numpy(image)
    return header, sheets


def finished(steps):
    """What a generator returns, and how often it yielded."""
    taken = 0
    while True:
        try:
            next(steps)
        except StopIteration as end:
            return end.value, taken
        taken += 1


LENSES = (EQUIDISTANT, opencv_lens((-0.2, 0.05)), EQUIRECT)


@pytest.mark.parametrize(
    ("recipe", "scale", "lens"),
    [("auto", 0.5, PINHOLE), ("auto", 0.125, PINHOLE), *(("classic", 1.0, x) for x in (PINHOLE, *LENSES))],
)
def test_strips_are_the_picture(seen, recipe, scale, lens, monkeypatch):
    monkeypatch.setattr("aaplug.rendering.strips.SAMPLES_PER_STRIP", 1000)
    renderer = Renderer.of(*seen, recipe, quality="best", rasterizer="eager")
    camera = replace(seen[1].train[0].scaled(scale), lens=lens)
    if lens != PINHOLE:
        camera = replace(camera, fx=camera.width / (2 * math.pi), fy=camera.width / (2 * math.pi))
    whole = renderer(camera)
    middle = camera.width // 3
    for columns in (None, (0, middle), (middle, camera.width)):
        render, taken = finished(strips(renderer, camera, renderer.samples(camera), columns))
        for image, expected in zip(render, whole, strict=True):
            torch.testing.assert_close(image, expected[:, slice(*(columns or (None,)))], atol=2e-5, rtol=0)
        assert taken > 1 or scale < 0.5


@pytest.mark.parametrize("samples", [1, 3])
def test_strips_of_another_count_weigh_neighbours_as_that_count_does(seen, samples):
    renderer = Renderer.of(*seen, "auto", quality="best", rasterizer="eager")
    colours = torch.rand(len(seen[0]), 1, 3, generator=torch.Generator().manual_seed(0))
    renderer = replace(renderer, scene=replace(renderer.scene, sh=4 * colours))
    camera = seen[1].train[0].scaled(1 / 4)
    assert samples != renderer.samples(camera)
    fine = camera.resized(camera.width * samples, camera.height * samples)
    weight = renderer.recipe.neighbours_at(samples / 4)
    expected = average_samples(renderer.paint(renderer.splats(fine, samples), fine.hw), samples, weight)
    render, _ = finished(strips(renderer, camera, samples))
    torch.testing.assert_close(render.rgb, expected.rgb, atol=2e-5, rtol=0)


def test_strips_draw_the_levels_of_the_picture():
    scenes = [make_scene(count) for count in (200, 150, 20)]
    levels = Pyramid.of(scenes, [torch.zeros(len(scene), dtype=torch.int64) for scene in scenes])
    camera = make_camera((0.0, -4.0, 0.0), (160, 120))
    renderer = Renderer.of(levels, [camera], rasterizer="eager")
    renderer = replace(renderer, recipe=replace(renderer.recipe, levels=LevelChoice()))
    view = camera.scaled(1 / 8)
    assert renderer.coarsening(*renderer.sampled(view)) > 0
    render, _ = finished(strips(renderer, view, renderer.samples(view)))
    torch.testing.assert_close(render.rgb, renderer(view).rgb, atol=2e-5, rtol=0)


@pytest.mark.parametrize(("at", "is_lossless"), [(0, True), (None, True), (0, False)])
def test_at_rest_a_page_has_the_library_s_own_pictures(subject, at, is_lossless, monkeypatch):
    if not is_lossless:
        monkeypatch.setattr(pictures, "MAX_LOSSLESS_PIXELS", 0)
    request = a_request(subject, scale=0.5 if is_lossless else 1.0, at=at)
    header, sheets = assembled(Pictures(subject).steps(request))
    assert header["stage"] == "done"
    for side, sheet in zip(SIDES, sheets, strict=True):
        how = {"quality": side.quality, "rasterizer": "eager"}
        expected = quantised(
            Renderer.of(subject.look.source, subject.cameras, side.recipe, **how)(subject.camera(request)).rgb
        )
        assert (float((sheet - expected).abs().max()) < 1.1 / 255) == is_lossless
        assert is_lossless or 40 < psnr(sheet, expected) < 80


def test_a_moving_camera_gets_one_quick_picture_of_what_is_visible(subject, monkeypatch):
    monkeypatch.setattr(pictures, "UNIT_SAMPLES", 2000)
    moving = Pictures(subject)
    request = a_request(subject, scale=2.0, split=0.25, moving=True)
    [message] = moving.steps(request)
    header, files = unpacked(message)
    assert header["stage"] == "moving"
    assert [part["span"] for part in header["parts"]] == [[0, request.width // 4], [request.width // 4, request.width]]
    assert header["scale"] < 1
    assert decoded(files[1]).shape[1] < request.width * 0.75
    resting = headers(moving.steps(replace(request, moving=False)))
    assert "moving" not in {header["stage"] for header in resting}  # it has that one


def test_the_effort_falls_with_slow_frames_and_grows_where_it_was_short():
    assert pictures._adapted(1.0, 2 * pictures.FRAME_SECONDS, is_limited=True) == pytest.approx(0.6)
    assert pictures._adapted(1.0, pictures.FRAME_SECONDS / 2, is_limited=True) > 1
    assert pictures._adapted(1.0, pictures.FRAME_SECONDS / 2, is_limited=False) == 1
    assert pictures._adapted(1 / 16, 9.0, is_limited=True) == 1 / 16


def test_what_is_done_is_not_drawn_again(subject):
    drawing = Pictures(subject)
    list(drawing.steps(a_request(subject)))
    [header] = headers(drawing.steps(a_request(subject, id=2, overlay="alpha")))
    assert (header["stage"], [part["of"] for part in header["parts"]]) == ("done", ["paint"])


@pytest.mark.parametrize("shrink", [1, 2, 4])
def test_a_photograph_of_any_size_has_the_figures_of_an_evaluation(seen, subject, shrink, tmp_path):
    photo = box_average(read_image(subject.views[0].photo), shrink)
    write_png(tmp_path / "photo.png", photo)
    views = replace(seen[1].train[0], photo=tmp_path / "photo.png"), seen[1].train[1]
    subject = replace(subject, cameras=CameraSet(views, views))
    request = a_request(subject, scale=0.5, photo=True)
    *_, message = filter(None, Pictures(subject).steps(request))
    header, [file] = unpacked(message)
    if shrink > 2:  # the picture is larger than the photograph, of which an evaluation gives no figure
        assert header["psnr"] is None
        return
    expected = box_average(photo, 2 // shrink)
    torch.testing.assert_close(decoded(file), expected, atol=0.6 / 255, rtol=0)
    images = [quantised(subject.renderer(side)(views[0].scaled(0.5)).rgb) for side in SIDES]
    assert header["psnr"] == pytest.approx([psnr(image, expected) for image in images], abs=0.02)
    assert header["whole"]
    assert header["parts"][0]["span"] == [0, request.width]


def test_a_view_in_a_larger_window_keeps_its_pixels(subject):
    request = a_request(subject, scale=0.5)
    wide = replace(request, width=request.width + 31, height=request.height + 8)
    view, left, top = subject.placed_view(wide)
    assert (left, top, view.width, view.height) == (15, 4, request.width, request.height)
    renderer = subject.renderer(SIDES[0])
    inner = renderer(subject.camera(wide)).rgb[top : top + view.height, left : left + view.width]
    torch.testing.assert_close(inner, renderer(subject.views[0].scaled(0.5)).rgb, atol=0.01, rtol=0)  # but for its edge


LAWS = {
    "alpha": lambda values: 0 <= values.min() < values.max() <= 1,
    "samples": lambda values: set(values.tolist()) == {4.0},
    "views": lambda values: 1 <= values.min() <= values.max() <= 2.001,
    "rate": lambda values: 0.2 < values.median() <= 0.51,  # half of the training size at a training pose
    "cost": lambda values: values.max() >= 4,
}


@pytest.mark.parametrize("name", OVERLAYS)
def test_overlays_tell_what_they_say(subject, name):
    renderer, camera = subject.renderer(SIDES[1]), subject.camera(a_request(subject, scale=0.5))
    values = OVERLAYS[name].values(renderer, camera, 2)
    assert values.shape == camera.hw
    assert LAWS[name](values[values.isfinite()])
    if name == "alpha":
        one_sample = replace(renderer.recipe, grid=1, target_rate=0.0, neighbours=0.0)
        torch.testing.assert_close(values, replace(renderer, recipe=one_sample)(camera).alpha)
    levels, legend = OVERLAYS[name](renderer, camera, 2)
    assert 0 <= float(levels.min()) <= float(levels.max()) <= 1
    assert legend["low"] < legend["high"]


def test_a_still_has_the_size_that_was_asked_for(subject):
    request = a_request(subject)
    *_, message = filter(None, Pictures(subject).ordered(request, StillRequest(60, 40, 1)))
    header, [file] = unpacked(message)
    assert header["still"] == "auto-60x40.png"
    expected = subject.renderer(SIDES[1])(subject.camera(request).framed(60, 40)).rgb
    assert float((decoded(file) - quantised(expected)).abs().max()) < 1.1 / 255


@pytest.mark.parametrize("background", [None, (1.0, 0.5, 0.0)])
def test_the_depth_of_a_place_is_told(subject, background):
    request = a_request(subject, background=background)
    depths = []
    for x, y in ((0.5, 0.5), (0.0, 0.0)):
        [message] = Pictures(subject).ordered(request, PickRequest(x, y))
        header, _ = unpacked(message)
        assert header["picked"] == [x, y]
        depths.append(header["depth"])
    assert 3 < depths[0] < 5.5  # the camera is 4 from the middle of the scene
    assert depths[1] is None


def test_a_newer_request_ends_the_older_one_between_strips(subject, monkeypatch):
    monkeypatch.setattr("aaplug.rendering.strips.SAMPLES_PER_STRIP", 200)
    page = Page(subject)
    page.receive(a_request(subject, id=1))
    for _ in range(3):
        page.step()
    assert page.steps is not None
    page.receive(a_request(subject, id=2, scale=0.25))
    messages = [message for _ in range(200) if (message := page.step() if page.busy else None)]
    assert {unpacked(message)[0]["id"] for message in messages} == {2}


def test_a_picture_that_fails_says_so_and_the_next_one_comes(subject, monkeypatch):
    page = Page(subject)
    with monkeypatch.context() as broken:
        broken.setattr(Pictures, "_preview", lambda *_: (_ for _ in ()).throw(MemoryError()))
        page.receive(a_request(subject))
        assert headers([page.step()]) == [{"problem": "out of memory"}]
    page.receive(a_request(subject, id=2))
    assert headers([page.step()])[0]["id"] == 2
