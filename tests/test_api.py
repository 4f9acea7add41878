"""The library gives what the command line gives: same names, defaults and images."""

import inspect
import json
import re
import runpy
import tomllib
from pathlib import Path

import pytest
import torch
from aaplug_cli.verbs import VERBS

import aaplug
from aaplug.system.errors import UsageError
from tests.conftest import ROOT, SAMPLE, run_python

LEAST_WRONG_CALLS = 3000


def test_python_in_the_readme_gives_the_command_lines_image(cli):
    Path("scene.ply").unlink()
    Path("scene.ply").symlink_to(SAMPLE / "chair.ply")
    Path("path/to").mkdir(parents=True)
    Path("path/to/colmap").symlink_to(SAMPLE)
    found = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    assert found
    Path("readme.py").write_text(found[1])
    image = runpy.run_path("readme.py")["image"]
    words = "render scene.ply --cameras path/to/colmap --views r_8 -o one.png --scale 0.25"
    cli.done(f"{words} --bit-depth 16")
    aaplug.write_png("two.png", image, bit_depth=16)
    assert Path("two.png").read_bytes() == Path("one.png").read_bytes()
    assert image[0, 0].min() == 1  # the chair's cameras say white


def test_a_renderer_applies_the_recipes_world_filter(cli):
    scene, cameras = aaplug.read_scene("scene.ply").gaussians(), aaplug.read_cameras(".")
    image = aaplug.Renderer.of(scene, cameras, "mip-splatting")(cameras.test[0].scaled(0.5)).rgb
    cli.done("render scene.ply --cameras . -o one.png --scale 0.5 --recipe mip-splatting --bit-depth 16")
    aaplug.write_png("two.png", image, bit_depth=16)
    assert Path("two.png").read_bytes() == Path("one.png").read_bytes()


def test_the_default_device_of_a_program_changes_nothing(cli, monkeypatch):
    def made() -> list[object]:
        scene, cameras = aaplug.read_scene("scene.ply"), aaplug.read_cameras(".")
        aaplug.write_scene("scene.glb", scene.gaussians(), overwrite=True)
        image = aaplug.Renderer.of(scene, cameras, rasterizer="eager")(cameras.test[0].scaled(0.5)).rgb
        return [Path("scene.glb").read_bytes(), image.tolist(), aaplug.info(scene, cameras)]

    expected = made()
    with torch.device("meta"):
        assert made() == expected
    monkeypatch.setattr("aaplug._imported", lambda name: torch.zeros(1))
    with torch.device("meta"):
        assert aaplug.imported_late.tolist() == [0]  # pyright: ignore[reportAttributeAccessIssue]


def test_an_option_that_is_none_is_refused_with_the_nearest_name():
    with pytest.raises(UsageError, match="scal: is no option here; did you mean scale"):
        aaplug.render("scene.ply", scal=0.5)
    with pytest.raises(AttributeError, match=r"attribute read_scenes; did you mean read_scene\?"):
        aaplug.read_scenes  # noqa: B018  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.parametrize("verb", sorted(VERBS.keys() - {"guide", "recipes", "viewers"}))  # which print alone
def test_verbs_have_the_options_of_the_command_line(verb):
    parameters = inspect.signature(getattr(aaplug, verb.replace("-", "_"))).parameters
    missing = parameters.keys() - VERBS[verb].options.keys() - {"monitor", "name", "words"}
    assert not missing
    for name, parameter in parameters.items():
        keyword = parameter.kind is inspect.Parameter.KEYWORD_ONLY
        assert not keyword or parameter.default is not inspect.Parameter.empty, name


def test_the_version_and_every_folder_of_the_library_are_packaged():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert aaplug.__version__ == stated["project"]["version"]
    listed = stated["tool"]["setuptools"]["packages"]
    folders = {".".join(file.parent.relative_to(ROOT).parts) for file in ROOT.glob("aaplug/**/__init__.py")}
    assert set(listed) == folders | {"aaplug_cli", "aaplug_cli.guides"}


def test_the_sample_is_small_and_tells_its_origin():
    files = [path for path in SAMPLE.rglob("*") if path.suffix in {".ply", ".json", ".png", ".md"}]
    assert sum(path.stat().st_size for path in files) < 6e6
    assert "CC0" in (SAMPLE / "ORIGIN.md").read_text()


def test_every_public_function_refuses_wrong_values_at_once_and_in_our_words():
    ends = json.loads(run_python("from tests.wrong_calls import main; main()").stdout)
    assert ends["calls"] >= LEAST_WRONG_CALLS
    assert not ends["forgotten"], "functions that are not called"
    assert not ends["raw"], "errors of another library"
    assert not ends["passed"], "a stranger was taken"
    assert not ends["slow"], "a second or more"
