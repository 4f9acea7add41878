"""The library gives what the command line gives: same names, defaults and images; a type checker knows the keywords."""

import inspect
import json
import re
import runpy
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import torch
from aaplug_cli.verbs import VERBS

import aaplug
from aaplug.options.base import docs_of
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
    made = runpy.run_path("readme.py")
    images, views = {"auto": made["image"]}, made["cameras"]
    images["mip-splatting"] = aaplug.Renderer.of(made["scene"], views, "mip-splatting")(views.test[0].scaled(1 / 4)).rgb
    words = "render scene.ply --cameras path/to/colmap --views r_8 --scale 0.25 --bit-depth 16 --overwrite -o one.png"
    for recipe, image in images.items():  # one of which has a world filter
        cli.done(f"{words} --recipe {recipe}")
        aaplug.write_png("two.png", image, bit_depth=16, overwrite=True)
        assert Path("two.png").read_bytes() == Path("one.png").read_bytes()
        assert image[0, 0].min() == 1  # the chair's cameras say white


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


def test_the_version_every_folder_of_the_library_and_a_small_sample_with_its_origin_are_packaged():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert aaplug.__version__ == stated["project"]["version"]
    listed = stated["tool"]["setuptools"]["packages"]
    folders = {".".join(file.parent.relative_to(ROOT).parts) for file in ROOT.glob("aaplug/**/__init__.py")}
    assert set(listed) == folders | {"aaplug_cli", "aaplug_cli.guides"}
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


# a keyword of each verb with a value, and the same misspelt
KEYWORDS = {
    "render": ("bit_depth=16", "bit_deph=16"),
    "convert": ("variance=0.1", "varience=0.1"),
    "evaluate": ("protocol='default'", "protocoll='default'"),
    "lod": ("merge_below=1.0", "merge_bellow=1.0"),
    "finetune": ("learning_rate=0.5", "lerning_rate=0.5"),
    "compare": ("any_frame=True", "anyframe=True"),
    "merge": ("into='mip'", "in_to='mip'"),
    "video": ("seconds=3.0", "second=3.0"),
    "info": ("min_seen=0.1", "min_sen=0.1"),
    "bench": ("repeats=3", "repeat=3"),
    "view": ("port=0", "prot=0"),
}
SCRIPT = """
import aaplug

SCENES = ["a.ply", "b.ply"]
"""


def call(verb: str, keyword: str) -> str:
    """A line that calls a verb with a keyword."""
    inputs = "SCENES" if verb in ("compare", "merge") else "SCENES[0]"
    return f"aaplug.{verb}({inputs}, 'cameras', {keyword})\n"


def test_a_misspelt_keyword_and_nothing_else_is_an_error(tmp_path):
    pytest.importorskip("basedpyright")
    lines = [call(verb, spelling) for verb, spellings in KEYWORDS.items() for spelling in spellings]
    (tmp_path / "user.py").write_text(SCRIPT + "".join(lines))
    how = {"extraPaths": [str(ROOT)], "typeCheckingMode": "standard"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(how))
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable, "-p", "."]
    answer = json.loads(subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300).stdout)
    assert answer["summary"]["filesAnalyzed"] == 1
    script = (tmp_path / "user.py").read_text().splitlines(keepends=True)
    told = [(script[each["range"]["start"]["line"]], each["message"]) for each in answer["generalDiagnostics"]]
    assert sorted(line for line, _ in told) == sorted(lines[1::2]), "one error a call"
    for line, message in told:
        assert any(f'"{wrong.partition("=")[0]}"' in message for _, wrong in KEYWORDS.values() if wrong in line), line


def test_help_of_python_tells_each_keyword_and_its_plain_type():
    verbs = [verb for name in aaplug.__all__ if hasattr(verb := getattr(aaplug, name), "options")]
    assert aaplug.render in verbs
    for verb in verbs:
        signature, options = inspect.signature(verb), docs_of(verb.options)
        assert options.keys() <= signature.parameters.keys()
        for name, doc in options.items():
            assert f"\n    {name}: {doc}\n" in f"{verb.__doc__}\n", (verb.__name__, name)
        assert "Annotated" not in str(signature), verb.__name__
