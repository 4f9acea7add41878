"""The live view without a browser: what a page may ask for, what it gets, and who is let in."""

import json
import math
import socket
import struct
import threading
import webbrowser
from contextlib import contextmanager
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from aaplug.core.cameras import CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.imaging import quantised
from aaplug.core.monitor import SILENT
from aaplug.evaluation.metrics import psnr
from aaplug.io.images import write_png
from aaplug.live import pictures
from aaplug.live.messages import See, Side, parsed
from aaplug.live.paints import PAINTS
from aaplug.live.pictures import Pictures
from aaplug.live.studio import Studio
from aaplug.live.subject import Subject
from aaplug.rendering.renderer import Renderer
from aaplug.rendering.strips import strips
from aaplug.verbs.view import attend, serving, view
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


# ------------------------------------------------------------------------------------------------------- the messages

POSE = torch.eye(4).flatten().tolist()
GOOD = {
    "id": 1, "pose": POSE, "focal": 50, "width": 40, "height": 30, "split": 0.5,
    "sides": [{"recipe": "classic", "quality": "best"}, {"recipe": "auto", "quality": "fast"}],
}  # fmt: skip
REFUSED = {
    "pose of NaN": ({"pose": [math.nan] * 16}, "pose: takes a number"),
    "pose of infinity": ({"pose": [math.inf, *POSE[1:]]}, "pose: takes a number"),
    "pose of words": ({"pose": ["../../etc/passwd"] * 16}, "pose: takes a number"),
    "short pose": ({"pose": POSE[:12]}, "pose: takes 16 numbers"),
    "mirror": ({"pose": [-1.0, *POSE[1:]]}, "pose: takes a rotation"),
    "stretched": ({"pose": [2 * x for x in POSE]}, "pose: takes a rotation"),
    "huge window": ({"width": 100_000, "height": 100_000}, "size: is 100000x100000 px; the limit is 8192"),
    "many pixels": ({"width": 8000, "height": 8000}, "size: is 8000x8000 px"),
    "no window": ({"width": 0}, "width: takes a number from 1"),
    "half a pixel": ({"width": 1.5}, "width: takes a whole number"),
    "focal": ({"focal": 0}, "focal: takes a number"),
    "truth": ({"focal": True}, "focal: takes a number"),
    "split": ({"split": 2}, "split: takes a number from 0 to 1"),
    "camera": ({"at": 7}, "at: takes a number from 0 to 1"),
    "one side": ({"sides": GOOD["sides"][:1]}, "sides: takes two objects"),
    "recipe": ({"sides": [{"recipe": "evil", "quality": "best"}] * 2}, "recipe: 'evil' is not one of classic, auto"),
    "quality": ({"sides": [{"recipe": "auto", "quality": "x" * 999}] * 2}, "is not one of fast, balanced, best"),
    "paint": ({"paint": "../secret"}, "paint: '../secret' is not one of rate"),
    "no id": ({"id": None}, "id: takes a number"),
}
GARBAGE = [
    b"\x00" * 9, "", "{", "[" * 9000, "null", "[1]", "{}",
    '{"see": 3}', '{"see": [], "shown": 1}', '{"open": "/etc/passwd"}',
    '{"still": {"width": 9, "height": 9, "side": 3}}', '{"shown": "x"}', '{"shown": 1e999}',
]  # fmt: skip


def test_a_good_message_is_taken():
    found = parsed(json.dumps({"see": GOOD | {"at": 1, "paint": "rate", "moving": True}}), RECIPES, 2)
    assert isinstance(found, See)
    assert (found.at, found.paint, found.moving, found.sides[1]) == (1, "rate", True, Side("auto", "fast"))


@pytest.mark.parametrize("name", REFUSED)
def test_a_message_out_of_bounds_is_refused_in_clear_words(name):
    other, words = REFUSED[name]
    with pytest.raises(UsageError) as error:
        parsed(json.dumps({"see": GOOD | other}), RECIPES, 2)
    assert words in str(error.value)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize("text", GARBAGE, ids=lambda text: str(text)[:20])
def test_garbage_is_refused(text):
    with pytest.raises(UsageError):
        parsed(text, RECIPES, 2)


# --------------------------------------------------------------------------------------------------------- the server


@pytest.fixture(scope="module")
def address(seen):
    with serving(*seen, port=0, rasterizer="eager") as address:
        yield address


@contextmanager
def connected(address: str, **how):
    client = pytest.importorskip("websockets.sync.client")
    target = address.replace("http", "ws", 1).partition("?")
    how = {"origin": address.partition("/?")[0].rstrip("/")} | how
    with client.connect(f"{target[0]}live{''.join(target[1:])}", proxy=None, max_size=None, **how) as connection:
        yield connection


def ask(connection, **other) -> dict:
    """What a page hears at last."""
    connection.send(json.dumps({"see": GOOD | other}))
    while True:
        header, _ = unpacked(connection.recv(timeout=20))
        connection.send('{"shown": 1}')
        if "problem" in header or header["stage"] == "done":
            return header


def raw(address: str, request: str) -> str:
    """What the server answers to bytes."""
    host, port = address.split("/")[2].split(":")
    with socket.create_connection((host, int(port)), timeout=10) as stream:
        stream.sendall(request.replace("\n", "\r\n").replace("HERE", f"{host}:{port}").encode("latin-1"))
        return b"".join(iter(lambda: stream.recv(4096), b"")).decode("latin-1")


def test_the_page_is_served_to_its_own_name_alone(address):
    page = raw(address, "GET / HTTP/1.1\nHost: HERE\n\n")
    assert page.startswith("HTTP/1.1 200")
    assert "frame-ancestors 'none'" in page
    assert "default-src 'none'" in page
    for host in ("evil.example:8080", "", "127.0.0.1.evil.example"):
        assert " 403 " in raw(address, f"GET / HTTP/1.1\nHost: {host}\n\n").splitlines()[0]
    assert " 404 " in raw(address, "GET /../../etc/passwd HTTP/1.1\nHost: HERE\n\n").splitlines()[0]


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None])
def test_a_websocket_of_another_page_is_refused(address, origin):
    exceptions = pytest.importorskip("websockets.exceptions")
    with pytest.raises(exceptions.InvalidStatus, match="403"), connected(address, origin=origin):
        pass


def test_a_network_address_asks_for_its_token(seen):
    exceptions = pytest.importorskip("websockets.exceptions")
    with serving(*seen, host="0.0.0.0", port=0, rasterizer="eager") as address:
        local = address.replace("0.0.0.0", "127.0.0.1")
        bare, _, token = local.partition("?")
        assert len(token) > 20
        assert " 403 " in raw(bare, "GET / HTTP/1.1\nHost: HERE\n\n")
        assert " 403 " in raw(bare, "GET /?token=wrong HTTP/1.1\nHost: HERE\n\n")
        assert " 200 " in raw(bare, f"GET /?{token} HTTP/1.1\nHost: HERE\n\n")
        with pytest.raises(exceptions.InvalidStatus, match="403"), connected(bare):
            pass
        with connected(local) as connection:
            assert json.loads(connection.recv())["views"]


def test_garbage_harms_nobody(address, capfd):
    exceptions = pytest.importorskip("websockets.exceptions")
    with connected(address) as good, connected(address) as bad:
        good.recv()
        bad.recv()
        for text in GARBAGE:
            bad.send(text)
            assert "problem" in unpacked(bad.recv(timeout=10))[0]
        assert "problem" in ask(bad, width=100_000)
        assert ask(bad)["stage"] == "done"
        bad.send("x" * 100_000)
        with pytest.raises(exceptions.ConnectionClosedError, match="1009"):
            bad.recv(timeout=10)
        for request in (
            "\n",
            "POST / HTTP/1.1\nHost: HERE\n\n",
            "\x16\x03\x01\x02\n\n",
            "GET " + 20_000 * "a" + "\n\n",
        ):
            raw(address, request)
        assert ask(good)["stage"] == "done"
    assert capfd.readouterr().err == ""


def test_a_pose_that_sees_nothing_has_a_picture(address):
    with connected(address) as connection:
        connection.recv()
        away = [*POSE[:11], 1e8, *POSE[12:]]
        assert ask(connection, pose=away)["stage"] == "done"


# -------------------------------------------------------------------------------------------------------- the command


def test_a_busy_port_is_one_clear_line(address, cli):  # noqa: F811
    port = address.split(":")[2].rstrip("/")
    code, _, err = cli(f"view scene.ply --cameras . --rasterizer eager --no-browser --port {port}")
    assert code == 2
    assert f"--port: {port} of 127.0.0.1 cannot be used: address already in use" in err.splitlines()[-1]


def test_a_scene_that_fails_to_load_opens_no_page(cli):  # noqa: F811
    code, _, err = cli("view missing.ply --no-browser --port 0")
    assert (code, len(err.splitlines())) == (2, 1)
    assert "missing.ply" in err


def test_the_command_says_where_and_ends_quietly(cli, monkeypatch):  # noqa: F811
    def interrupted(self, timeout=None):
        raise KeyboardInterrupt

    monkeypatch.setattr(
        "aaplug.verbs.view.threading", type("Fake", (), {"Event": type("E", (), {"wait": interrupted})})
    )
    code, _, err = cli("view scene.ply --cameras . --rasterizer eager --no-browser --port 0")
    assert code == 0
    assert "open http://127.0.0.1:" in err
    assert err.splitlines()[-1] == "closed"


def test_without_a_scene_the_sample_opens(monkeypatch):
    opened = []
    monkeypatch.setattr("aaplug.verbs.view.attend", lambda address, *_: opened.append(address))
    view(port=0, rasterizer="eager")
    assert opened[0].startswith("http://127.0.0.1:")


def test_a_browser_in_the_terminal_is_not_opened(monkeypatch):
    opened = []
    windowed = type("Windowed", (), {"open": lambda self, address: opened.append(address)})()
    event = type("Event", (), {"wait": lambda self: None})
    monkeypatch.setattr("aaplug.verbs.view.threading", type("Threading", (), {"Event": event}))
    for browser in (webbrowser.GenericBrowser("lynx"), windowed):
        monkeypatch.setattr(webbrowser, "get", lambda chosen=browser: chosen)
        attend("http://there/", SILENT, no_browser=False)
    attend("http://there/", SILENT, no_browser=True)
    assert opened == ["http://there/"]


def test_without_the_extra_it_says_how_to_get_it(monkeypatch, seen):
    monkeypatch.setattr("aaplug.verbs.view.find_spec", lambda name: None)
    with pytest.raises(UsageError, match="pip install 'aaplug\\[view\\]'"):
        view(*seen, port=0)


def test_words_of_the_command_line_name_what_is_seen(tmp_path):
    from aaplug_cli.options import CameraOptions, SceneOptions
    from aaplug_cli.view import _words

    scene = SceneOptions(scene=tmp_path / "s.ply", convention="mip", drop_bad=True)
    assert _words(scene) == [str(tmp_path / "s.ply"), "--convention", "mip", "--drop-bad"]
    assert _words(CameraOptions(cameras=tmp_path, train_scale=0.5)) == [
        "--cameras",
        str(tmp_path),
        "--train-scale",
        "0.5",
    ]
    assert _words(CameraOptions().orbit) == []
