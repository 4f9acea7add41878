"""A package that is not part of aaplug adds one of everything: the steps of examples/guides/contributing.md."""

import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from aaplug.io.images import image_size
from aaplug.io.scenes import read_scene, write_scene
from tests.conftest import SAMPLE

ROOT = Path(__file__).resolve().parents[1]
PLUGIN = ROOT / "tests" / "plugin"
GUIDE = ROOT / "examples" / "guides" / "contributing.md"
PROGRAM = [sys.executable, "-c", "from aaplug_cli.main import main; main()"]
LAWS = "soft or dull or four-points or row-by-row or balls or look or MAE"  # as in the guide
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


@pytest.fixture
def aaplug(installed: dict[str, str], tmp_path: Path):
    """Run the program with the plug-in, in a folder with a small scene; gives its stdout."""
    scene = read_scene(SAMPLE / "chair.ply")
    largest = scene.log_scales.sum(dim=1).topk(300).indices.sort().values
    write_scene(tmp_path / "scene.ply", scene[largest])

    def run(*words: str) -> str:
        done = subprocess.run(
            [*PROGRAM, *words], cwd=tmp_path, env=installed, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run


def test_the_guide_shows_the_files_of_the_plug_in():
    shown = dict(
        re.findall(r"`stranger/(\w+\.py)`:\n\n```python\n(.*?)```$", GUIDE.read_text(), re.M | re.S)
    )
    assert shown.keys() == FILES
    for name, text in shown.items():
        assert text == (PLUGIN / "stranger" / name).read_text(), name
    (project,) = re.findall(
        r"`pyproject.toml`:\n\n```toml\n(.*?)```$", GUIDE.read_text(), re.M | re.S
    )
    assert project == (PLUGIN / "pyproject.toml").read_text()


def test_every_file_of_the_plug_in_is_registered_by_one_line():
    registered = [value for points in GROUPS.values() for value in points.values()]
    modules = [value.removeprefix("stranger.").split(":")[0] + ".py" for value in registered]
    assert sorted(modules) == sorted(FILES)


def test_evaluate_knows_their_recipe_and_metric(aaplug):
    words = ["scene.ply", "--cameras", str(SAMPLE), "--views", "r_8", "--scale", "0.0625"]
    printed = aaplug("evaluate", *words, "--recipe", "soft-points", "--metric", "mae", "--json")
    (result,) = (value for name, value in json.loads(printed).items() if "soft-points" in name)
    assert 0 < result["MAE"] < 0.5


def test_render_knows_their_formats_and_rasterizer(aaplug, tmp_path):
    views = [("left", -1, 0), ("right", 1, 0), ("held", 0, 1)]
    (tmp_path / "views.look").write_text(
        "".join(LOOK.format(name=name, x=x, held_out=held) for name, x, held in views)
    )
    aaplug("convert", "scene.ply", "--cameras", str(SAMPLE), "-o", "scene.balls")
    words = ["scene.balls", "--cameras", "views.look", "--rasterizer", "row-by-row"]
    aaplug("render", *words, "--recipe", "soft-points", "-o", "images")
    assert [path.name for path in (tmp_path / "images").iterdir()] == ["held.png"]
    assert image_size(tmp_path / "images" / "held.png") == (40, 30)


def test_help_knows_their_names(aaplug):
    text = aaplug("evaluate", "--help")
    for name in ("soft-points", "mae", "row-by-row"):
        assert name in text, name


def test_the_laws_run_over_what_the_plug_in_adds(installed):
    words = ["-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", "tests/laws", "-k", LAWS]
    done = subprocess.run(
        [sys.executable, *words, "-v"], cwd=ROOT, env=installed, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout[-5000:]
    for name in ("soft", "dull", "four-points", "row-by-row", "soft-points"):
        assert re.search(rf"\[.*{name}.*\] PASSED", done.stdout), f"no law ran over {name}"
