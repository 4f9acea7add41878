"""A type checker knows the keywords of every verb, which are stated as fields of its options."""

import importlib.util
import inspect
import json
import subprocess
import sys
from pathlib import Path

import pytest

import aaplug
from aaplug.options.base import docs_of
from tests.conftest import ROOT

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


@pytest.fixture(scope="module")
def errors(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, str]]:
    """What the type checker says, by the script's name and the text of the line."""
    if importlib.util.find_spec("basedpyright") is None:
        pytest.skip("basedpyright is not installed")
    folder: Path = tmp_path_factory.mktemp("user")
    for place, name in enumerate(("right", "misspelt")):
        lines = [call(verb, spellings[place]) for verb, spellings in KEYWORDS.items()]
        (folder / f"{name}.py").write_text(SCRIPT + "".join(lines))
    how = {"extraPaths": [str(ROOT)], "typeCheckingMode": "standard"}
    (folder / "pyrightconfig.json").write_text(json.dumps(how))
    command = [sys.executable, "-m", "basedpyright", "--outputjson", "--pythonpath", sys.executable, "-p", str(folder)]
    answer = json.loads(subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300).stdout)
    assert answer["summary"]["filesAnalyzed"] == 2
    told: dict[str, dict[str, str]] = {"right": {}, "misspelt": {}}
    for problem in answer["generalDiagnostics"]:
        script = Path(problem["file"])
        line = script.read_text().splitlines()[problem["range"]["start"]["line"]] + "\n"
        assert line not in told[script.stem], "one error a call"
        told[script.stem][line] = problem["message"]
    return told


def test_a_misspelt_keyword_and_nothing_else_is_an_error(errors):
    assert errors["right"] == {}
    misspelt = {call(verb, keyword): f'"{keyword.partition("=")[0]}"' for verb, (_, keyword) in KEYWORDS.items()}
    assert errors["misspelt"].keys() == misspelt.keys()
    assert [line for line, name in misspelt.items() if name not in errors["misspelt"][line]] == []


def test_help_of_python_tells_each_keyword_and_its_plain_type():
    verbs = [verb for name in aaplug.__all__ if hasattr(verb := getattr(aaplug, name), "options")]
    assert aaplug.render in verbs
    for verb in verbs:
        signature, options = inspect.signature(verb), docs_of(verb.options)
        assert options.keys() <= signature.parameters.keys()
        for name, doc in options.items():
            assert f"\n    {name}: {doc}\n" in f"{verb.__doc__}\n", (verb.__name__, name)
        assert "Annotated" not in str(signature), verb.__name__
