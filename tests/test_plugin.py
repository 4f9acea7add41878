"""A package that is not part of aaplug adds one of everything: the steps of examples/guides/contributing.md."""

import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import tomllib
from argparse import ArgumentParser
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, EntryPoints, entry_points
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from aaplug import METRICS, CameraSet, Colour, Metric, Recipe, Render, Renderer, Scene, check_plugin, evaluate, finetune
from aaplug.evaluation.laws.base import make_camera, make_scene
from aaplug.finetuning import LOSSES
from aaplug.io.cameras import CAMERA_FORMATS, read_cameras
from aaplug.io.images import image_size
from aaplug.io.scenes import SCENE_FORMATS, read_scene, write_scene
from aaplug.lab.gaussian_blending import GaussianBlending
from aaplug.methods.pixel_kernels.point import Point
from aaplug.system.errors import FormatError, PlugInError, UsageError
from aaplug.system.registry import Registry, _points_of
from aaplug.system.signals import _exit
from tests.conftest import ROOT, SAMPLE, run_python
from tests.test_documented import GAUSSIANS, few, write_cameras

GUIDE = (ROOT / "examples" / "guides" / "contributing.md").read_text()
PROGRAM = """
import json, os, sys
os.chdir("{folder}")
from aaplug_cli.main import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit as stop:
        if stop.code:
            raise
"""
FILES = dict(re.findall(r"`stranger/(\w+\.py)`:\n\n```python\n(.*?)```$", GUIDE, re.M | re.S))
(TOML,) = re.findall(r"`pyproject.toml`:\n\n```toml\n(.*?)```$", GUIDE, re.M | re.S)
GROUPS = tomllib.loads(TOML)["project"]["entry-points"]
CAMERAS = CameraSet((make_camera(size=(16, 12)),), (make_camera(size=(16, 12)),))
LOOK = "{name} 40 30 50  {x} -4 1  0 0 0  {held_out}\n"  # see camera_format.py


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which one process with the plug-in has run the guide's commands, a `--help` and `recipes`.

    The plug-in is installed without pip: a .dist-info on the path is enough.
    """
    site, folder = tmp_path_factory.mktemp("site"), tmp_path_factory.mktemp("theirs")
    (site / "stranger").mkdir()
    for name, text in FILES.items():
        (site / "stranger" / name).write_text(text)
    record = site / "stranger-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    groups = ("\n".join([f"[{group}]", *map(" = ".join, points.items())]) for group, points in GROUPS.items())
    (record / "entry_points.txt").write_text("\n".join(groups))
    write_scene(folder / "scene.ply", few(read_scene(SAMPLE / "chair.ply").gaussians()))
    write_cameras(folder / "path" / "to" / "colmap")
    views = [("left", -1, 0), ("right", 1, 0), ("held", 0, 1)]
    lines = (LOOK.format(name=name, x=x, held_out=held) for name, x, held in views)
    (folder / "views.look").write_text("".join(lines))
    commands = [line for line in GUIDE.splitlines() if line.startswith("aaplug ")]
    words = [shlex.split(command)[1:] for command in [*commands, "aaplug evaluate --help", "aaplug recipes"]]
    path = os.pathsep.join([str(site), str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = run_python(PROGRAM.format(folder=folder), json.dumps(words), PYTHONPATH=path, COLUMNS=400)
    assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-5000:]
    (folder / "stdout").write_text(done.stdout)
    return folder


@pytest.mark.skipif(shutil.which("ruff") is None, reason="ruff is not installed")
@pytest.mark.parametrize("verb", ["check --ignore D1", "format --check"])
@pytest.mark.parametrize("name", FILES)
def test_the_files_of_the_plug_in_are_in_our_own_style(name, verb):
    command = ["ruff", *verb.split(), "--no-cache", f"--stdin-filename=tests/{name}", "-"]
    done = subprocess.run(command, cwd=ROOT, input=FILES[name], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_each_step_names_the_test_that_tries_it():
    rows = re.findall(r"^\| ([\d, ]+) \| (`test_.*) \|$", GUIDE, re.M)
    tried = {step for steps, _ in rows for step in steps.split(", ")}
    assert tried == set(re.findall(r"^## (\d+)\. ", GUIDE, re.M))
    for _, names in rows:
        for name in re.findall(r"`(\w+)`", names):
            assert callable(globals().get(name)), name


def test_every_file_of_the_plug_in_is_registered_by_one_line():
    registered = [value for points in GROUPS.values() for value in points.values()]
    modules = [value.removeprefix("stranger.").split(":")[0] + ".py" for value in registered]
    assert sorted(modules) == sorted(FILES)


def test_evaluate_knows_their_recipe_and_metric(finished):
    results = json.loads((finished / "results" / "results.json").read_text())
    (found,) = (value for name, value in results.items() if "soft-points" in name)
    assert 0 < found["MAE"] < 0.5


def test_render_knows_their_formats_and_rasterizer(finished):
    assert (finished / "scene.balls").read_text().count("\n") == GAUSSIANS
    assert [path.name for path in (finished / "images").iterdir()] == ["held.png"]
    assert image_size(finished / "images" / "held.png") == (40, 30)


def test_help_knows_their_names(finished):
    text = (finished / "stdout").read_text()
    for name in ("soft-points", "mae", "row-by-row"):
        assert re.search(rf"[|{{,\s]{name}\b", text), name


def test_the_table_of_recipes_has_theirs_among_those_to_use(finished):
    used = (finished / "stdout").read_text().split("--recipe ")[-2]
    assert re.search(r"^soft-points +1 sample .* nobody's: the example", used, re.M)


def test_the_laws_run_over_what_the_plug_in_adds(finished):
    text = (finished / "stdout").read_text()
    for name in ("soft", "dull", "four-points", "row-by-row", "soft-points", "MAE", "balls", "look"):
        assert re.search(rf"\b{name}\b.*passed", text), f"no law ran over {name}"
    assert "failed" not in text


def test_laws_name_what_breaks_them_and_leave_out_what_a_module_imports(stand_in):
    odd = replace(METRICS["PSNR"], name="odd", measure=lambda image, truth: image)
    others = {"Colour": Colour, "where": np.where, "maximum": np.maximum, "measure": lambda image, truth: 0}
    stand_in("imports", ODD=odd, **others)
    [verdict] = check_plugin("imports")
    assert (verdict.kind, verdict.name) == ("metric", "odd")
    assert verdict.problem.startswith("metric odd: gives no number but Tensor")


def test_a_loss_that_an_entry_point_names_is_tried(monkeypatch, stand_in):
    filters = torch.rand(4, 3, 32, 32)  # as a network has them: float32, and larger than some images
    losses = {
        "sum": lambda image, truth: (image - truth).square().sum(),
        "perceptual": lambda image, truth: torch.conv2d((image - truth).permute(2, 0, 1), filters).square().mean(),
        "mean": lambda image, truth: image.mean(),
        "half": lambda image, truth: ((image - truth).detach() + image - truth).square().mean(),
    }
    stand_in("losses", **losses)
    points = [EntryPoint(name, f"losses:{name}", "aaplug.losses") for name in losses]
    monkeypatch.setattr("aaplug.verbs.check_plugin.entry_points", lambda group: points * (group == "aaplug.losses"))
    verdicts = {(name, law.partition(" ")[0]): problem for _, name, law, problem in check_plugin("losses")}
    assert len(verdicts) == 4 * 2
    assert [name for (name, _), problem in verdicts.items() if problem] == ["mean", "half"]


@dataclass(frozen=True)
class Wrong:
    """A filter, kernel, compositor, rasterizer and format whose answer to everything is that of `answers`."""

    answers: Callable[..., Any]
    name: str = "wrong"
    sign: str = ""
    needs: None = None

    def __call__(self, *given: Any) -> Any:
        return self.answers(*given)

    def sniff(self, path: Path, *_: Any) -> bool:
        return path.suffix == ".wrong"

    open_scene = read = write = __call__


@dataclass(frozen=True)
class WrongKernel(Point):
    name: str = "wrong"
    answers: Callable[..., Any] = max

    def alpha(self, *given: Any) -> Any:
        return self.answers(super().alpha(*given))


@dataclass(frozen=True)
class WrongCompositor(GaussianBlending):
    name: str = "wrong"
    answers: Callable[..., Any] = max

    def tiles(self, *given: Any) -> Any:
        return self.answers(super().tiles(*given))


def fails(*given: Any) -> Any:
    raise KeyError("key")


def ends(*given: Any) -> Any:
    sys.exit("wrong")


def spoils(thing: Any, *_: Any) -> Any:
    """Writes to its input."""
    value = thing if isinstance(thing, torch.Tensor) else next(x for x in vars(thing).values() if x is not None)
    value.mul_(1)
    return thing


def drawn(**parts: Any) -> None:
    rasterizer = parts.pop("rasterizer", "eager")
    recipe = Recipe("theirs", **{"screen": lambda splats, camera, training: splats, **parts}, source="", when="")
    Renderer.of(make_scene(20), CAMERAS, recipe, rasterizer=rasterizer)(CAMERAS.test[0])


def by(part: str) -> Callable[..., None]:
    return lambda answers, *_: drawn(**{part: Wrong(answers)})


def evaluated(answers: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, *_: Any) -> None:
    metric = replace(METRICS["PSNR"], name="wrong", measure=answers)
    monkeypatch.setitem(METRICS._entries, "wrong", metric)
    evaluate(make_scene(20), CAMERAS, metric="wrong", recipe="classic", scale=(0.5,), rasterizer="eager")


def tuned(answers: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setitem(LOSSES._entries, "wrong", answers)
    finetune(make_scene(20), CAMERAS, folder / "tuned.ply", loss="wrong", steps=1, rasterizer="eager")


def filed(formats: Registry[Any], use: Callable[[Path], Any]) -> Callable[..., None]:
    """Uses a file of the wrong format."""

    def used(answers: Callable[..., Any], monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
        monkeypatch.setitem(formats._entries, "wrong", Wrong(answers))
        (folder / "file.wrong").write_text("x")
        use(folder / "file.wrong")

    return used


VERBS = {
    "screen filter wrong": by("screen"),
    "world filter wrong": by("world"),
    "rasterizer wrong": by("rasterizer"),
    "pixel kernel wrong": lambda answers, *_: drawn(pixel=WrongKernel(answers=answers)),
    "compositor wrong": lambda answers, *_: drawn(compositor=WrongCompositor(answers=answers)),
    "metric wrong": evaluated,
    "loss wrong": tuned,
    "scene format wrong": filed(SCENE_FORMATS, lambda path: read_scene(path).gaussians()),
    "writing scene format wrong": filed(
        SCENE_FORMATS, lambda path: write_scene(path.with_name("new.wrong"), make_scene(3))
    ),
    "camera format wrong": filed(CAMERA_FORMATS, read_cameras),
}
NAN = "expected finite numbers, got"
MISTAKES: dict[tuple[str, str], tuple[Callable[..., Any], str]] = {
    **{(where, "raises"): (fails, "KeyError: 'key', in line") for where in VERBS},
    **{(where, "ends the program"): (ends, "SystemExit: wrong, in line") for where in VERBS},
    ("screen filter wrong", "returns nothing"): (lambda *_: None, "should return a Splats2D, got None"),
    ("screen filter wrong", "spoils"): (spoils, "changes its input: means"),
    ("screen filter wrong", "builds"): (
        lambda splats, *_: splats.blurred("x"),
        "fails with variance: expected a number or a tensor [m] of float32 or float64, got 'x', in line",
    ),
    ("screen filter wrong", "precision"): (
        lambda splats, *_: replace(splats, covs=splats.covs.double()),
        "covs: expected float32 [20, 3], as given, got float64 [20, 3]",
    ),
    ("screen filter wrong", "nan"): (
        lambda splats, *_: replace(splats, opacities=splats.opacities * math.nan),
        f"opacities: {NAN} 20 of 20 that are NaN or infinite",
    ),
    ("world filter wrong", "fewer"): (
        lambda scene, _: scene[:3],
        "means: expected float32 [20, 3], as given, got float32 [3, 3]",
    ),
    ("rasterizer wrong", "shape"): (
        lambda *_: Render(torch.zeros(16, 12, 3), torch.zeros(16, 12)),
        "rgb: expected [12, 16, 3], got [16, 12, 3]",
    ),
    ("rasterizer wrong", "tuple"): (
        lambda *_: (torch.zeros(12, 16, 3), 1),
        "should return a Render, got a tuple of float32 [12, 16, 3], 1",
    ),
    ("pixel kernel wrong", "shape"): (lambda alpha: alpha[..., 1:], "fails with RuntimeError"),
    ("pixel kernel wrong", "nan"): (lambda alpha: alpha * math.nan, f"rgb: {NAN} some"),
    ("compositor wrong", "returns nothing"): (lambda _: None, "fails with"),
    ("metric wrong", "spoils"): (lambda image, truth: spoils(image).sum(), "changes its input: argument 1"),
    ("metric wrong", "stops"): (lambda image, truth: next(iter(())), "StopIteration"),
    ("loss wrong", "shape"): (lambda image, truth: image, "should return a tensor [] of float32 or float64"),
    ("loss wrong", "no gradient"): (lambda image, truth: image.detach().mean(), "gradient"),
    ("loss wrong", "nan"): (lambda image, truth: image.mean() * math.nan, "step 1: expected a finite number, got nan"),
    ("scene format wrong", "returns nothing"): (lambda *_: None, "should return a Scene, got None"),
    ("scene format wrong", "loads"): (
        lambda path, _: Scene(path, "wrong", 3, 0, fails, ""),
        "file.wrong with KeyError: 'key', in line",
    ),
    ("writing scene format wrong", "writes nothing"): (lambda *_: None, "has not written"),
    ("camera format wrong", "returns a list"): (lambda *_: [make_camera()], "CameraSet, got a list of a Camera"),
}


@pytest.mark.parametrize("case", MISTAKES, ids=", ".join)
def test_a_plug_in_that_fails_in_a_verb_is_named(case, monkeypatch, tmp_path):
    where, (answers, problem) = case[0], MISTAKES[case]
    with pytest.raises(PlugInError) as caught:
        VERBS[where](answers, monkeypatch, tmp_path)
    assert caught.value.where == where.removeprefix("writing ")
    assert problem in caught.value.problem
    if case[1] == "raises":
        assert isinstance(caught.value.__cause__, KeyError)


@pytest.mark.parametrize("handler", [_exit, lambda *_: ArgumentParser().exit(143)], ids=["worker", "program"])
def test_a_program_that_a_signal_ends_inside_a_plug_in_ends(handler, monkeypatch, tmp_path):
    with pytest.raises(SystemExit, match="143"):
        evaluated(lambda *_: handler(signal.SIGTERM, None), monkeypatch, tmp_path)


def test_a_camera_format_that_fails_after_another_read_the_folder_is_named(monkeypatch):
    @dataclass(frozen=True)
    class Reads(Wrong):
        def sniff(self, path: Path, *_: Any) -> bool:
            return True

    monkeypatch.setitem(CAMERA_FORMATS._entries, "first", Reads(lambda *_: CAMERAS))
    monkeypatch.setitem(CAMERA_FORMATS._entries, "wrong", Wrong(max))
    monkeypatch.setattr(Wrong, "sniff", fails)
    with pytest.raises(PlugInError, match=r"^camera format wrong: fails on .* with KeyError: 'key'"):
        read_cameras(SAMPLE)


def test_a_camera_file_without_cameras_is_named(monkeypatch, tmp_path):
    with pytest.raises(FormatError, match=r"file\.wrong: holds no training cameras"):
        VERBS["camera format wrong"](lambda *_: CameraSet((), ()), monkeypatch, tmp_path)


def test_a_plug_in_words_its_own_errors(monkeypatch, tmp_path):
    refuses = Mock(side_effect=UsageError("scale", "is not for this metric"))
    with pytest.raises(UsageError, match=r"^scale: is not for this metric$"):
        evaluated(refuses, monkeypatch, tmp_path)


@pytest.mark.parametrize(
    ("name", "object", "problem"),
    [
        ("psnr", "odd", "a metric named 'PSNR' exists already"),
        ("other", "odd", "is registered as 'other' but calls itself 'odd'"),
        ("class", "Metric", "is the class Metric, which is not a metric"),
        ("missing", "nothing", "cannot be imported: AttributeError"),
    ],
)
def test_an_entry_point_that_is_left_out_is_a_broken_law(name, object, problem, monkeypatch, stand_in):
    stand_in("left", Metric=Metric, odd=replace(METRICS["PSNR"], name="odd"))
    metrics = Registry("metric", "aaplug.evaluation.metric:Metric", {"PSNR": METRICS["PSNR"]})
    monkeypatch.setattr("aaplug.evaluation.METRICS", metrics)
    point = EntryPoint(name, f"left:{object}", "aaplug.metrics")
    monkeypatch.setattr(
        "aaplug.system.registry._points_of", lambda kind: (point,) if kind == "metric" else _points_of(kind)
    )
    verdict = next(each for each in check_plugin("left") if each.problem)
    assert (verdict.kind, verdict.name, verdict.law) == ("metric", name, "Its entry point registers it.")
    assert verdict.problem.startswith(problem)


def test_an_entry_point_of_an_unknown_group_is_a_broken_law(monkeypatch, stand_in):
    odd = [EntryPoint("odd", "left:odd", "aaplug.metric"), EntryPoint("odd", "other:odd", "aaplug.odd")]
    usual = [point for group in entry_points().groups for point in entry_points(group=group)]
    stand_in("left")
    monkeypatch.setattr("aaplug.system.registry._points", lambda: EntryPoints([*usual, *odd]))
    [verdict] = check_plugin("left")
    assert verdict[:3] == ("entry point", "odd", "Its entry point registers it.")
    assert verdict.problem.startswith("group aaplug.metric is not known; did you mean aaplug.metrics")


def test_what_lacks_a_part_of_its_interface_is_told_it():
    kernels = Registry("pixel kernel", "aaplug.core.interfaces:PixelKernel", {})
    with pytest.raises(UsageError, match="not a pixel kernel as it lacks columns, needs_depth_slopes, splats_per_pass"):
        kernels.register("odd", Mock(spec=["name", "bounding_ellipses", "raster_rows", "alpha", "exact"]))


def test_an_import_that_ends_the_program_is_told(tmp_path, monkeypatch):
    (tmp_path / "ends_here.py").write_text("\nraise SystemExit(3)\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(UsageError, match=r"cannot be imported: SystemExit: 3, in line 2 of ends_here.py"):
        check_plugin("ends_here")


def test_a_broken_law_shows_where_it_raises(stand_in):
    stand_in("tests", RAISES=replace(METRICS["PSNR"], name="odd", measure=fails))
    [verdict] = check_plugin("tests")
    assert re.fullmatch(r"KeyError: 'key', in line \d+ of test_plugin.py", verdict.problem)


def test_threads_may_use_a_name_for_the_first_time_at_once(monkeypatch):
    together, psnr = threading.Barrier(3), METRICS["PSNR"]

    def found(place: str) -> Any:
        together.wait(timeout=10)
        return psnr

    monkeypatch.setattr("aaplug.system.registry.resolve_name", found)
    registry = Registry[Any]("metric", "aaplug.evaluation:Metric", {"PSNR": "there:PSNR"})
    monkeypatch.setattr(Registry, "type", Metric)
    with ThreadPoolExecutor(3) as threads:
        metrics = list(threads.map(lambda _: registry["PSNR"], range(3)))
    assert metrics == [psnr] * 3
