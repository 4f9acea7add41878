"""Scenes and cameras that tests share.

`shared_data` is a folder of real scenes that may lie beside the repository; tests that use it skip where it is absent.
"""

import contextlib
import gc
import json
import logging
import math
import multiprocessing
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from aaplug_cli.main import main

from aaplug import RASTERIZERS, Gaussians, Rasterizer, Renderer, Splats2D, TrainingViews, read_cameras, write_png
from aaplug.core.cameras import Camera, CameraSet
from aaplug.evaluation.laws.base import make_camera as make_camera
from aaplug.evaluation.laws.base import make_scene as make_scene
from aaplug.evaluation.laws.base import make_splats as make_splats
from aaplug.io.scenes import read_scene, write_scene
from aaplug.lab.learned import NAMES
from aaplug.lab.pixel_size import PixelSizes
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rasterizers.tiled import Tiled, on_demand
from aaplug.rasterizers.tiled.ahead_of_time import load
from tests import check_again

COMPILED = load()
on_demand.PATIENCE_SECONDS = 1e9  # tests compile nothing beside their work
ALL_RASTERIZERS: dict[str, Rasterizer] = {**RASTERIZERS, **({} if COMPILED is None else {"compiled": Tiled(COMPILED)})}

ROOT = Path(__file__).resolve().parents[1]
GUIDES = sorted((ROOT / "examples" / "guides").glob("*.md"))
SHARED_DATA = ROOT.parent / "shared" / "data"
SAMPLE = Path(str(files("aaplug.io.sample")))
CLEAR_REFS = Path("/proc/self/clear_refs")
EYES = {"train": [(0.0, -4.0, 0.0), (2.0, -3.5, 1.0), (-3.0, -3.0, 0.5)], "test": [(1.0, -4.0, 0.0)]}
SIZE = (64, 48)  # px
needs_peak_memory = pytest.mark.skipif(not CLEAR_REFS.exists(), reason="peak memory of a process is read from /proc")


def pytest_configure() -> None:
    """Test processes run side by side; threads that wait for each other, or for the disk, would stall them all."""
    torch.set_num_threads(1)
    os.fsync = lambda descriptor: None  # no test pulls the plug


def pytest_collection_finish() -> None:
    """Leave all that was imported out of searches for garbage, and of pytest's five at the end."""
    gc.freeze()


@pytest.fixture(autouse=True)
def own_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the library's log handlers after each test, which the command line replaces; check its types anew."""
    check_again()
    logger = logging.getLogger("aaplug")
    monkeypatch.setattr(logger, "handlers", list(logger.handlers))
    monkeypatch.setattr(logger, "propagate", True)


def each(entries: Mapping[str, Any]) -> Any:
    """A fixture that is each of these in turn, by name."""
    return pytest.fixture(params=entries.values(), ids=entries)(lambda request: request.param)


rasterize = each({name: partial(rasterizer, pixel=POINT) for name, rasterizer in ALL_RASTERIZERS.items()})


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("no folder of real scenes beside the repository")
    return SHARED_DATA


@pytest.fixture(scope="session")
def sample_scene() -> Gaussians:
    return read_scene(SAMPLE / "chair.ply").gaussians()


@pytest.fixture(scope="session")
def sample_cameras() -> CameraSet:
    return read_cameras(SAMPLE)


@pytest.fixture(scope="session")
def sample_training(sample_scene: Gaussians, sample_cameras: CameraSet) -> TrainingViews:
    return TrainingViews.of(sample_scene, sample_cameras)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    """A folder with scene.ply, three training cameras and a test camera with its photograph."""
    return make_dataset(tmp_path_factory.mktemp("dataset"))


def make_dataset(folder: Path) -> Path:
    """A scene, training cameras, and a test camera with its photograph."""
    write_scene(folder / "scene.ply", make_scene(150))
    for split, eyes in EYES.items():
        write_transforms(folder, split, eyes)
    (folder / "test").mkdir()
    write_png(folder / "test" / "r_0.png", torch.zeros(SIZE[1], SIZE[0], 3))
    cameras = read_cameras(folder)
    scene = read_scene(folder / "scene.ply").gaussians()
    image = Renderer.of(scene, cameras, "classic", rasterizer="eager")(cameras.test[0]).rgb
    write_png(folder / "test" / "r_0.png", image, overwrite=True)
    return folder


@dataclass(frozen=True)
class Program:
    """The program, in this process; gives (exit code, stdout, stderr)."""

    capsys: pytest.CaptureFixture[str]

    def __call__(self, words: str) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(words.split())
        printed = self.capsys.readouterr()
        return int(stop.value.code or 0), printed.out, printed.err

    def done(self, words: str) -> tuple[str, str]:
        """What a run prints that succeeds, (stdout, stderr)."""
        code, out, err = self(words)
        assert code == 0, err
        return out, err

    def facts(self, words: str) -> dict[str, Any]:
        """What a run prints with `--json` that succeeds."""
        return json.loads(self.done(f"{words} --json")[0])

    def refused(self, words: str, *said: str) -> str:
        """The line in which a run is refused, which says that; no file is written or changed."""
        before = times_of_files()
        code, out, err = self(words)
        assert (code, out) == (2, ""), err
        last = err.rstrip("\n").split("\n")[-1]
        assert last.startswith("error: ")
        assert all(text in last for text in said), last
        assert times_of_files() == before
        return last


def times_of_files() -> dict[Path, int | None]:
    """When each file in this folder was changed; of folders only that they are there, as claims come and go."""
    return {path: path.stat().st_mtime_ns if path.is_file() else None for path in Path().rglob("*")}


@pytest.fixture
def program(tmp_path, monkeypatch, capsys) -> Program:
    """The program in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return Program(capsys)


@pytest.fixture
def cli(dataset, program) -> Program:
    """The program in a fresh folder holding a copy of the data set."""
    shutil.copytree(dataset, Path(), dirs_exist_ok=True)
    return program


def made_by(words: str, dataset: Path, folder: Path) -> Path:
    """The folder, with a copy of the data set and what a run of the program made in it."""
    shutil.copytree(dataset, folder, dirs_exist_ok=True)
    with contextlib.chdir(folder), pytest.raises(SystemExit, match="0"):
        main(words.split())
    return folder


@pytest.fixture
def stand_in(monkeypatch) -> Callable[..., ModuleType]:
    """Makes modules by a name and what they hold."""

    def module(name: str, **held: object) -> ModuleType:
        made = ModuleType(name)
        vars(made).update(held)
        monkeypatch.setitem(sys.modules, name, made)
        return made

    return module


_drawn: dict[str, bytes] = {}


@pytest.fixture
def plots_drawn_once(monkeypatch) -> None:
    """Of the plots of one kind of file the first is drawn, and stands for the others: drawing takes longest."""
    from aaplug.evaluation.report.plots import Plot  # programs that import this file need no matplotlib

    draw = Plot._saved

    def saved(plot: Plot, kind: str, ink: str, **settings: Any) -> bytes:
        if kind not in _drawn:
            _drawn[kind] = draw(plot, kind, ink, **settings)
        return _drawn[kind]

    monkeypatch.setattr(Plot, "_saved", saved)


def with_photographs(
    look: Renderer, views: Iterable[Camera], folder: Path, gain: float = 1.0, lift: float = 0.0
) -> CameraSet:
    """The views, as training and as test views, each with a photograph: what the look shows of it, changed a little."""
    found = []
    for number, view in enumerate(views):
        photo = folder / f"photo_{number}.png"
        write_png(photo, (look(view).rgb * gain + lift).clamp(0, 1))
        found.append(replace(view, photo=photo))
    return CameraSet(tuple(found), tuple(found))


def write_transforms(folder: Path, split: str, eyes: list[tuple[float, float, float]]) -> None:
    cameras = [make_camera(eye, SIZE) for eye in eyes]
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # Blender looks along −z with y up
    frames = [
        {"file_path": f"./{split}/r_{i}", "transform_matrix": (np.linalg.inv(c.cam_from_world.numpy()) @ flip).tolist()}
        for i, c in enumerate(cameras)
    ]  # fmt: skip
    angle = 2 * math.atan(0.5 * SIZE[0] / cameras[0].fx)
    data = {"camera_angle_x": angle, "w": SIZE[0], "h": SIZE[1], "frames": frames}
    (folder / f"transforms_{split}.json").write_text(json.dumps(data))


def write_model(folder: Path, cameras: Iterable[Camera], config: str, scene: Gaussians, *iterations: int) -> Path:
    """A model folder as 3DGS writes it."""
    for iteration in iterations:
        write_scene(folder / f"point_cloud/iteration_{iteration}/point_cloud.ply", scene)
    entries = [
        {"id": number, "img_name": view.name, "width": view.width, "height": view.height, "fx": view.fx, "fy": view.fy}
        | {"position": view.centre.tolist(), "rotation": view.cam_from_world[:3, :3].T.tolist()}
        for number, view in enumerate(cameras)
    ]
    (folder / "cameras.json").write_text(json.dumps(entries))
    (folder / "cfg_args").write_text(f"Namespace({config})")
    return folder


CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
]  # fmt: skip


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
def watched(browser) -> Iterator[Callable[..., Any]]:
    """A function that opens an empty page; nothing may go wrong in it, and it asks for nothing elsewhere."""
    pages, troubles = [], []

    def new_page(width: int = 1280, height: int = 900, **other: Any) -> Any:
        page = browser.new_page(viewport={"width": width, "height": height}, **other)
        pages.append(page)
        page.on("console", lambda line: troubles.append(line.text))
        page.on("pageerror", lambda error: troubles.append(str(error)))
        page.on("request", lambda sent: None if sent.url.startswith(("file:", "data:")) else troubles.append(sent.url))
        return page

    yield new_page
    for page in pages:
        page.close()
    assert troubles == []


def place(page: Any, x: float, y: float, on: str = "#picture") -> tuple[float, float]:
    """A place on the screen, from shares of an element."""
    box = page.locator(on).bounding_box()
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


def drag(page: Any, start: tuple[float, float], end: tuple[float, float], button: str = "left", **on: str) -> None:
    """Move the mouse with a button held down, from one place of an element to another."""
    page.mouse.move(*place(page, *start, **on))
    page.mouse.down(button=button)
    page.mouse.move(*place(page, *end, **on), steps=4)
    page.mouse.up(button=button)


def click(box: Any) -> None:
    """Click a box of a page itself: a picture that arrives may move it away from under a mouse."""
    box.dispatch_event("click")


def run_python(program: str, *words: object, **variables: object) -> subprocess.CompletedProcess[str]:
    """Run a program in a process of its own, with these words and variables of the environment."""
    command = [sys.executable, "-c", program, *map(str, words)]
    environment = os.environ | {name: str(value) for name, value in variables.items()}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    print(done.stderr)  # which is shown where the test fails
    return done


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """No file of this process grows beyond so many bytes, as where a disk is full."""
    import resource  # which Windows lacks

    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


def exit_code(work: Callable[[], object]) -> int | None:
    """That of a copy of this process which does the work; negative where a signal ended it."""
    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    child.join(120)
    return child.exitcode


MEASURE = """
import os, torch
torch.set_num_threads(1)
{prepare}
def peak():
    words = open("/proc/self/status").read().split()
    return int(words[words.index("VmHWM:") + 1]) * 1024
works = {works}
for i, work in enumerate(works, 1):
    if i < len(works) and os.fork():
        assert os.wait()[1] == 0
        continue
    {warm}
    open("/proc/self/clear_refs", "w").write("5")  # resets the peak, which imports raised
    before = peak()
    exec(work)
    print(peak() - before, flush=True)
    os._exit(0)
"""


def memory_taken(prepare: str, *works: str, warm: str = "pass") -> list[int]:
    """Bytes by which each of the statements raises the peak of a fresh process, or of a copy of it.

    A process that ran others has memory to reuse.  A copy, of which all but the last are, also counts the code it runs,
    which differs between builds of torch, but for what the statement `warm` ran before.
    """
    return [*map(int, run_python(MEASURE.format(prepare=prepare, works=works, warm=warm)).stdout.split())]


@pytest.fixture(scope="session")
def cameras() -> list[Camera]:
    """Views from all around, near and far."""
    eyes = [(0.0, -4.0, 0.0), (3.0, -3.5, 1.0), (-1.0, -2.5, 1.5), (0.5, 5.0, -1.0)]
    return [make_camera(eye, name=f"view_{i}") for i, eye in enumerate(eyes)]


def assert_equal(a: Gaussians, b: Gaussians) -> None:
    """Every column of both is equal to the bit."""
    for name, column in a.columns.items():
        assert torch.equal(column, b.columns[name]), name


def shuffled(noun: Any, seed: int = 0) -> Any:
    """Its Gaussians, or splats, in another order."""
    return noun[torch.randperm(len(noun), generator=torch.Generator().manual_seed(seed))]


def moved(camera: Camera, offset: Iterable[float]) -> Camera:
    """The camera moved by an offset in the world."""
    pose = camera.cam_from_world.clone()
    pose[:3, 3] -= pose[:3, :3] @ torch.tensor([*offset], dtype=pose.dtype)
    return replace(camera, cam_from_world=pose)


def straight_camera(
    focal: float = 100.0, size: tuple[int, int] = (80, 60), centre: tuple[float, float] | None = None, back: float = 0.0
) -> Camera:
    """At (0, 0, -back), looking along +z, with x and y as in the image."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = back
    return Camera("straight", *size, focal, focal, *(centre or (size[0] / 2, size[1] / 2)), pose)


def sized(scene: Gaussians) -> Gaussians:
    """The scene with the columns that recipes read: pixel sizes of Multi-Scale 3DGS, and learned filters.

    By the first, in most views some Gaussians are too small or too large.
    """
    n = len(scene)
    sizes = PixelSizes(torch.full((n,), 4.0), torch.full((n,), 8.0), torch.arange(n) % 4 == 0)
    learned = {name: torch.linspace(-0.3, 0.3, n).roll(k) for k, name in enumerate(NAMES)}
    return replace(scene, extras=sizes.extras | learned)


def splats_of(*rows: tuple) -> Splats2D:
    """Splats of (mean, covariance, depth, opacity, colour), in float64."""
    means, covs, depths, opacities, colours = zip(*rows, strict=True)
    covs = torch.tensor(covs, dtype=torch.float64)
    return Splats2D(
        means=torch.tensor(means, dtype=torch.float64),
        covs=covs,
        dets=covs[:, 0] * covs[:, 2] - covs[:, 1].square(),
        depths=torch.tensor(depths, dtype=torch.float64),
        opacities=torch.tensor(opacities, dtype=torch.float64),
        sources=torch.arange(len(rows)),
        rgb=torch.tensor(colours, dtype=torch.float64),
    )
