"""The live view's server: what a page may ask for, who is let in, and the command."""

import asyncio
import errno
import json
import math
import os
import re
import socket
import webbrowser
from contextlib import contextmanager
from functools import partial
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from aaplug import AaplugError, UsageError, serving, view
from aaplug.live.messages import PictureRequest, Side, parse
from aaplug.live.pictures import Page
from aaplug.live.subject import Subject
from aaplug.rendering.renderer import Renderer
from aaplug.system.executors import given_threads, torch_threads
from aaplug.system.extras import install_command
from aaplug.system.locks import LOCK_FILE_NAME, SCRATCH_PREFIX
from tests.test_view import RECIPES, seen, unpacked  # noqa: F401  (a fixture)

POSE = torch.eye(4).flatten().tolist()
GOOD = {
    "id": 1, "pose": POSE, "focal": 50, "width": 40, "height": 30, "split": 0.5,
    "sides": [{"recipe": "classic", "quality": "best"}, {"recipe": "auto", "quality": "fast"}],
}  # fmt: skip


def sides(recipe="auto", quality="best"):
    return {"sides": [{"recipe": recipe, "quality": quality}] * 2}


REFUSED = [
    ({"pose": [math.nan] * 16}, "NaN is not a finite number"),
    ({"pose": ["../../etc/passwd"] * 16}, "see: pose should be a number"),
    ({"pose": POSE[:12]}, "pose should be 16 numbers"),
    ({"pose": [-1.0, *POSE[1:]]}, "expected a rotation, got one that mirrors"),
    ({"pose": [2 * x for x in POSE]}, "expected a rotation"),
    ({"width": 10**5, "height": 10**5}, "width should be a whole number of px from 1 to 8192, not 100000"),
    ({"width": 8000, "height": 8000}, "size should be at most 33,554,432 px, not '8000x8000'"),
    ({"width": 0}, "width should be a whole number of px from 1"),
    ({"width": ""}, "width should be a number, not ''"),
    ({"width": 1.5}, "width should be a whole number"),
    ({"focal": 0}, "focal should be from"),
    ({"focal": True}, "focal should be a number"),
    ({"split": 2}, "split should be from 0 to 1"),
    ({"at": 7}, "at should be a whole number from 0 to 1"),
    ({"sides": GOOD["sides"][:1]}, "sides should be two, not 1"),
    (sides(recipe="evil"), "recipe should be one of classic, auto, mip, not 'evil'"),
    (sides(recipe=""), "recipe should be one of classic, auto, mip, not ''"),
    (sides(quality="x" * 999), "quality should be one of fast, balanced, best"),
    ({"paint": "../secret"}, "paint should be one of rate"),
    ({"background": "red"}, "background should be #rrggbb, not 'red'"),
    ({"id": None}, "id should be a number"),
]
GARBAGE = [
    b"\x00" * 9, "", "{", "[" * 9000, "null", "[1]", "{}",
    '{"see": 3}', '{"see": [], "shown": 1}', '{"open": "/etc/passwd"}',
    '{"still": {"width": 9, "height": 9, "side": 3}}', '{"pick": {"x": 2, "y": 0}}', '{"pick": 1}',
    '{"shown": "x"}', '{"shown": 1e999}',
]  # fmt: skip


def test_a_good_message_is_taken():
    request = parse(json.dumps({"see": GOOD | {"at": 1, "paint": "rate", "moving": True}}), RECIPES, 2)
    assert isinstance(request, PictureRequest)
    assert (request.at, request.overlay, request.moving, request.sides[1]) == (1, "rate", True, Side("auto", "fast"))


@pytest.mark.parametrize(("other", "words"), REFUSED, ids=range(len(REFUSED)))
def test_a_message_out_of_bounds_is_refused_in_clear_words(other, words):
    with pytest.raises(AaplugError) as error:
        parse(json.dumps({"see": GOOD | other}), RECIPES, 2)
    assert words in str(error.value)
    assert len(str(error.value)) < 200


@pytest.fixture(scope="module")
def address(seen):  # noqa: F811
    with serving(*seen, port=0) as address:
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
        if "refused" in header or header["stage"] == "done":
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
    for host in ("evil.example:8080", "", "127.0.0.1.evil.example", "["):
        assert " 403 " in raw(address, f"GET / HTTP/1.1\nHost: {host}\n\n").splitlines()[0]
    for host in ("LOCALHOST", "LocalHost:8080", "[::1]:8080"):
        assert " 200 " in raw(address, f"GET / HTTP/1.1\nHost: {host}\n\n").splitlines()[0]


def test_no_target_is_a_fault_of_the_server(address):
    for target in ("/../../etc/passwd", "//[", "//[x]:y/", "*", "http://[", "/live?[", "/?a=%ff&[=1"):
        answer = raw(address, f"GET {target} HTTP/1.1\nHost: HERE\n\n").splitlines()[0]
        assert any(f" {code} " in answer for code in (200, 403, 404)), answer


def refused(address: str, **how):
    exceptions = pytest.importorskip("websockets.exceptions")
    with pytest.raises(exceptions.InvalidStatus, match="403"), connected(address, **how):
        pass


def test_a_websocket_of_another_page_is_refused(address):
    for origin in ("http://evil.example", "null", None):
        refused(address, origin=origin)


def test_a_network_address_asks_for_its_token(seen):  # noqa: F811
    with serving(*seen, host="0.0.0.0", port=0) as address:
        assert "//0.0.0.0" not in address  # which some systems do not open, and no other machine
        local = address.replace(socket.gethostname(), "127.0.0.1")
        bare, _, token = local.partition("?")
        assert len(token) > 20
        assert " 403 " in raw(bare, "GET / HTTP/1.1\nHost: HERE\n\n")
        assert " 403 " in raw(bare, "GET /?token=wrong HTTP/1.1\nHost: HERE\n\n")
        assert " 200 " in raw(bare, f"GET /?{token} HTTP/1.1\nHost: HERE\n\n")
        refused(bare)
        with connected(local) as connection:
            assert json.loads(connection.recv())["views"]


def test_a_server_that_cannot_begin_lets_nobody_wait(seen, monkeypatch):  # noqa: F811
    def run(serve):
        serve.close()
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(asyncio, "run", run)
    with pytest.raises(UsageError, match="cannot be used: too many open files"), serving(*seen, port=0):
        pass


class FakePage(Page):
    """A page whose socket says that it has got each picture, or takes one and no other."""

    reads: bool = True

    async def send(self, picture: bytes):
        self.receive(None) if self.reads else await asyncio.Event().wait()


def test_pages_are_drawn_in_turn_and_none_waits_for_one_that_does_not_read(seen, monkeypatch):  # noqa: F811
    """Nothing of what that one wants is kept for it, whatever it says that it has got; all given cores draw."""
    monkeypatch.setattr("aaplug.rendering.strips.SAMPLES_PER_STRIP", 100)
    scene, cameras = seen
    subject = Subject(cameras, Renderer.of(scene, cameras, "matched", rasterizer="eager"), RECIPES, "a scene", ())
    server_module = pytest.importorskip("aaplug.live.server")
    with torch_threads(1, given=2):
        server = server_module.Server(subject, lambda path: subject, "localhost", 0)
    request, taken = parse(json.dumps({"see": GOOD}), RECIPES, 2), []

    def step(page: Page):
        taken.append((pages.index(page), given_threads()))
        return Page.step(page)

    async def draw():
        tasks = [asyncio.create_task(server._draw(page, page.send)) for page in pages]
        while any(page.busy for page in pages[:2]):
            pages[2].received = pages[2].sent
            await asyncio.sleep(0.01)
        for task in tasks:
            task.cancel()

    pages = [FakePage(subject) for _ in range(3)]
    pages[2].reads = False
    for page in pages:
        page.receive(request)
        page.step = partial(step, page)
    asyncio.run(draw())
    assert [place for place, _ in taken[:3]] == [0, 1, 2]
    assert [place for place, _ in taken[3:11]] == [0, 1] * 4
    assert pages[2].sent == 1
    assert {threads for _, threads in taken} == {2}


NO_NAMES = ("../a.ply", "/etc/passwd", 100 * "é" + 100 * "e", "C:a\\b.ply", ".a.ply")
NO_SCENES = [
    *(({"name": name, "size": 3}, [], "name should be ") for name in NO_NAMES),
    ({"name": "a.ply", "size": 0}, [], "a.ply: is empty"),
    ({"name": "a.ply", "size": 2**50}, [], "more than the temporary folder takes"),
    ({"name": "a.ply", "size": 3}, [b"ab", b"cd"], "longer than it was announced"),
    ({"name": "a.ply", "size": 4}, [b"ab", b"cd"], "a.ply: "),
]


def test_a_file_that_cannot_be_opened_is_refused(address):
    with connected(address) as page:
        page.recv()
        for named, parts, words in NO_SCENES:
            page.send(json.dumps({"open": named}))
            for part in parts:
                assert part is not parts[0] or unpacked(page.recv(timeout=10))[0] == {"take": "a.ply"}
                page.send(part)
            header, _ = unpacked(page.recv(timeout=10))
            assert words in header["refused"]
            assert "/tmp" not in header["refused"]
        assert ask(page)["stage"] == "done"


def test_the_folder_of_dropped_files_is_removed_by_others_once_its_server_was_killed(address, tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with connected(address) as page:
        page.recv()
        [folder] = tmp_path.iterdir()
        assert folder.name.startswith(SCRATCH_PREFIX)
        assert [path.name for path in folder.iterdir()] == [LOCK_FILE_NAME]


def test_garbage_harms_nobody(address, capfd):
    exceptions = pytest.importorskip("websockets.exceptions")
    with connected(address) as good, connected(address) as bad:
        good.recv()
        bad.recv()
        for text in GARBAGE:
            bad.send(text)
            assert "refused" in unpacked(bad.recv(timeout=10))[0]
        assert "refused" in ask(bad, width=100_000)
        assert ask(bad, pose=[*POSE[:11], 1e8, *POSE[12:]])["stage"] == "done"  # it sees nothing
        bad.send("x" * 100_000)
        with pytest.raises(exceptions.ConnectionClosedError, match="1009"):
            bad.recv(timeout=10)
        for request in ("\n", "POST / HTTP/1.1\nHost: HERE\n\n", "\x16\x03\x01\x02\n\n", f"GET {20_000 * 'a'}\n\n"):
            raw(address, request)
        assert ask(good)["stage"] == "done"
    assert capfd.readouterr().err == ""


def test_a_busy_port_is_one_clear_line(address, cli):
    port = address.split(":")[2].rstrip("/")
    said = f"--port: {port} of 127.0.0.1 cannot be used: address already in use"
    words = f"view scene.ply --cameras . --rasterizer eager --no-browser --port {port}"
    cli.refused(words, said)


@pytest.mark.parametrize("host", [70 * "x", "::g", "192.0.2.1"])  # no name; no address; another machine
def test_a_host_that_cannot_be_listened_at_is_refused_by_name(seen, host):  # noqa: F811
    with pytest.raises(UsageError, match=f"^host: {re.escape(host)} cannot be used: ['a-z]"), serving(*seen, host=host):
        pass


def test_the_command_says_where_and_ends_quietly(cli, monkeypatch):
    monkeypatch.setattr("aaplug.verbs.view.time", SimpleNamespace(sleep=Mock(side_effect=KeyboardInterrupt)))
    _, err = cli.done("view scene.ply --cameras . --rasterizer eager --no-browser --port 0")
    assert "open http://127.0.0.1:" in err
    assert err.splitlines()[-1] == "closed"


def test_a_browser_in_the_terminal_is_not_opened_and_without_a_scene_the_sample_is_seen(monkeypatch):
    opened = []
    monkeypatch.setattr("aaplug.verbs.view.time", SimpleNamespace(sleep=Mock(side_effect=KeyboardInterrupt)))
    for browser in (webbrowser.GenericBrowser("lynx"), SimpleNamespace(open=opened.append)):
        monkeypatch.setattr(webbrowser, "get", lambda chosen=browser: chosen)
        view(port=0)
    view(port=0, no_browser=True)
    [address] = opened
    assert address.startswith("http://127.0.0.1:")


def test_without_the_extra_it_says_how_to_get_it(monkeypatch, seen):  # noqa: F811
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=re.escape(install_command("view"))):
        view(*seen, port=0)


def test_words_of_the_command_line_name_what_is_seen(tmp_path):
    from aaplug_cli.inputs import CameraOptions, SceneOptions
    from aaplug_cli.verbs import VERBS

    from aaplug.options.verbs import Orbit

    scene = [str(tmp_path / "s.ply"), "--convention", "mip", "--drop-bad"]
    cameras = ["--cameras", str(tmp_path), "--train-scale", "0.5"]
    words = VERBS["view"].parse([*scene, *cameras])
    assert words.given(SceneOptions) == scene
    assert words.given(CameraOptions) == cameras
    assert words.given(Orbit) == []
