"""A type checker knows the keywords of every verb, which are stated as fields of its options."""

import inspect
import json
import subprocess
import sys

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
