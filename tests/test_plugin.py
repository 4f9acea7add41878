"""A package that is not part of aaplug adds one of everything: the steps of examples/guides/contributing.md."""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from aaplug.core.colours import Colour
from aaplug.evaluation import METRICS
from aaplug.io.images import image_size
from aaplug.io.scenes import read_scene, write_scene
from aaplug.verbs.check_plugin import check_plugin
from tests.conftest import SAMPLE
from tests.test_documented import GAUSSIANS, few, write_cameras

ROOT = Path(__file__).resolve().parents[1]
PLUGIN = ROOT / "tests" / "plugin"
GUIDE = ROOT / "examples" / "guides" / "contributing.md"
PROGRAM = """
import json, sys
from aaplug_cli.main import main
for words in json.loads(sys.argv[1]):
    try:
        main(words)
    except SystemExit as stop:
        if stop.code:
            raise
"""
FILES = {path.name for path in (PLUGIN / "stranger").glob("[!_]*.py")}
GROUPS = tomllib.loads((PLUGIN / "pyproject.toml").read_text())["project"]["entry-points"]
LOOK = "{name} 40 30 50  {x} -4 1  0 0 0  {held_out}\n"  # see camera_format.py


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a process that has the plug-in installed, without pip: a .dist-info on the path is enough."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "stranger").symlink_to(PLUGIN / "stranger")
    record = folder / "stranger-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    lines = [
        line
        for group, points in GROUPS.items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in points.items()))
    ]
    (record / "entry_points.txt").write_text("\n".join(lines))
    path = os.pathsep.join([str(folder), str(ROOT), os.environ.get("PYTHONPATH", "")])
    return {**os.environ, "PYTHONPATH": path, "COLUMNS": "400"}


@pytest.fixture(scope="module")
def finished(installed: dict[str, str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which one process with the plug-in has run the guide's commands, a `--help` and `recipes`."""
    folder = tmp_path_factory.mktemp("theirs")
    write_scene(folder / "scene.ply", few(read_scene(SAMPLE / "chair.ply").gaussians()))
    write_cameras(folder / "path" / "to" / "colmap")
    views = [("left", -1, 0), ("right", 1, 0), ("held", 0, 1)]
    lines = (LOOK.format(name=name, x=x, held_out=held) for name, x, held in views)
    (folder / "views.look").write_text("".join(lines))
    commands = [line for line in GUIDE.read_text().splitlines() if line.startswith("aaplug ")]
    words = [shlex.split(command)[1:] for command in [*commands, "aaplug evaluate --help", "aaplug recipes"]]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, json.dumps(words)], cwd=folder, env=installed, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-3000:] + done.stdout[-5000:]
    (folder / "stdout").write_text(done.stdout)
    return folder


def test_the_guide_shows_the_files_of_the_plug_in():
    shown = dict(re.findall(r"`stranger/(\w+\.py)`:\n\n```python\n(.*?)```$", GUIDE.read_text(), re.M | re.S))
    assert shown.keys() == FILES
    for name, text in shown.items():
        assert text == (PLUGIN / "stranger" / name).read_text(), name
    (project,) = re.findall(r"`pyproject.toml`:\n\n```toml\n(.*?)```$", GUIDE.read_text(), re.M | re.S)
    assert project == (PLUGIN / "pyproject.toml").read_text()


def test_each_step_names_the_test_that_tries_it():
    text = GUIDE.read_text()
    rows = re.findall(r"^\| ([\d, ]+) \| (`test_.*) \|$", text, re.M)
    tried = {step for steps, _ in rows for step in steps.split(", ")}
    assert tried == set(re.findall(r"^## (\d+)\. ", text, re.M))
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


def test_laws_name_what_breaks_them_and_leave_out_what_a_module_imports(monkeypatch):
    module = ModuleType("imports")
    odd = replace(METRICS["PSNR"], name="odd", measure=lambda image, truth: image)
    vars(module).update(Colour=Colour, where=np.where, maximum=np.maximum, ODD=odd)
    monkeypatch.setitem(sys.modules, "imports", module)
    [verdict] = check_plugin("imports")
    assert (verdict.kind, verdict.name) == ("metric", "odd")
    assert verdict.problem.startswith("metric odd: gives no number but Tensor")
