"""Help, and mistakes on the command line, are answered before torch is imported."""

import json
import resource
import shlex
import subprocess
import sys
from dataclasses import replace

import pytest
from aaplug_cli.verbs import VERBS

from aaplug import RECIPES, UsageError
from aaplug.finetuning.settings import CONSISTENCY, CONSISTENCY_SETTINGS, RATES, settings_of
from aaplug.options.verbs import TUNED_PARAMETERS, FinetuneOptions, RenderOptions
from aaplug.system.extras import install_command
from aaplug.system.registry import REGISTRIES, names_of, registry_of
from tests.conftest import run_python
from tests.test_options import REFUSED

SLOW = ["torch", "numpy", "cv2", "jaxtyping", "beartype", "scipy", "skimage", "matplotlib", "PIL", "av"]
SLOW += ["distributed", "dask", "viser", "aaplug.lab"]
START = "from aaplug_cli.main import program; program()"
STARTS = {"import": ("-c", "import aaplug"), "version": ("-c", START, "--version"), "help": ("-c", START, "--help")}
MAX_RATIOS = {"import": 3, "version": 5, "help": 9}  # to a bare start of Python, about 20 ms
PROGRAM = """
import json, sys
import aaplug
from aaplug_cli.main import main
words, slow = json.loads(sys.argv[1])
found = []
for each in words:
    try:
        main(each.split())
    except SystemExit as stop:
        found.append([each, stop.code or 0, [name for name in slow if name in sys.modules]])
print(json.dumps(found))
"""
HELPS = ["--version", "--help", *(f"{verb} --help" for verb in VERBS)]
MISTAKES = [
    *("", "flyy", *REFUSED),
    *("render -o out", "video -o v.webm", "convert -o c.ply", "lod -o l.ply", "finetune -o t.ply", "evaluate"),
    *("info", "compare", "compare one.ply"),
    *("render s.ply -o out --recipe mipp", "render s.ply -o out --quality good", "video s.ply -o v.webm --beside mipp"),
    *("evaluate s.ply --recipe mip mipp", "evaluate s.ply --protocol blend", "evaluate s.ply --rasterizer fast"),
    *("render s.ply -o out --rate-reference pos", "render s.ply -o out --convention clasic"),
    *("convert s.ply -o c.ply --for web", "convert s.ply -o c.ply --form web"),
    *("finetune s.ply -o t.ply --for web", "finetune s.ply -o t.ply --loss l3", "finetune s.ply -o t.ply --method m"),
    *("compare a.ply b.ply --for web", "compare a.ply b.ply --for spark --recipe mip", "lod s.ply -o l --scale 0.5"),
    *("render s.ply -o out --orbit 2 --eye 1 2 3", "bench --rasterizer fast"),
    *("info no.ply", "render no.ply -o out", "merge no.ply one.ply -o m.ply"),
]


def answered(words: list[str]) -> list[tuple[str, int, list[str]]]:
    """Each command's words and exit code, and the slow packages that were imported by its end."""
    return json.loads(run_python(PROGRAM, json.dumps([words, SLOW])).stdout.splitlines()[-1])


def test_help_and_mistakes_import_nothing_slow():
    expected = [[words, 0, []] for words in HELPS] + [[words, 2, []] for words in MISTAKES]
    assert answered([*HELPS, *MISTAKES]) == expected


def processor_time(*words: str) -> float:
    """Seconds of the quickest of several starts of Python; other processes would lengthen the clock's."""
    seconds = []
    for _ in range(5):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, *words], stdout=subprocess.DEVNULL, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds.append(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return min(seconds)


def test_the_program_starts_quickly(monkeypatch):
    monkeypatch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
    bare = processor_time("-c", "pass")
    ratios = {name: processor_time(*words) / bare for name, words in STARTS.items()}
    print(bare, ratios)
    assert all(ratios[name] < most for name, most in MAX_RATIOS.items()), ratios


@pytest.mark.parametrize("kind", REGISTRIES)
def test_names_are_known_before_what_they_name(kind):
    assert names_of(kind) == list(registry_of(kind))


def test_other_names_agree_with_what_they_name():
    assert tuple(RATES) == TUNED_PARAMETERS
    assert settings_of(CONSISTENCY, FinetuneOptions()) == CONSISTENCY_SETTINGS


def test_a_recipe_that_python_registers_can_be_named(monkeypatch):
    with pytest.raises(UsageError, match="recipe: 'mine' is not one of auto"):
        RenderOptions(recipe="mine")
    monkeypatch.setattr(RECIPES, "_entries", dict(RECIPES))
    RECIPES.register("mine", replace(RECIPES["mip"], name="mine"))
    assert RenderOptions(recipe="mine").recipe == "mine"


def test_the_command_for_an_extra_finds_the_installation(tmp_path):
    """pip looks nowhere else for what is installed already, wherever that came from."""
    pytest.importorskip("pip")
    command = [sys.executable, "-m", *shlex.split(install_command("view")), "--no-index", "--dry-run"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "Requirement already satisfied: aaplug[view]" in done.stdout, done.stderr
