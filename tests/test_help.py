"""What --help says: an example, whole lines, and no word that belongs elsewhere."""

import ast
import json
import re
import sys
from pathlib import Path

import pytest
from aaplug_cli.verbs import VERBS

from aaplug.methods import RECIPES
from aaplug.options.verbs import IN_TIME, LOSS_WEIGHTS
from aaplug.system.registry import names_of
from tests.conftest import GUIDES, ROOT

FILES = [*sorted((ROOT / "aaplug" / "options").glob("*.py")), *sorted((ROOT / "cli").glob("*.py"))]


HEADING = re.compile(r"^ ([a-z ]+?) +\n [-─]+ *$", re.MULTILINE)  # of a part of --help, where there is no terminal


def helps(file: Path) -> list[str]:
    """The docstrings of a file's options: strings that follow a field."""
    classes = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ClassDef)]
    pairs = [pair for node in classes for pair in zip(node.body, node.body[1:], strict=False)]
    return [
        after.value.value
        for field, after in pairs
        if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    ]


def test_an_option_is_told_in_one_line():
    """The parser keeps the ends of a docstring's lines, which then fall anywhere."""
    texts = [text for file in FILES for text in helps(file)]
    assert len(texts) > 60
    assert [text for text in texts if "\n" in text] == []


def test_help_states_which_verbs_take_frames_and_what_the_anchor_weighs_against():
    scene = next(text for text in helps(ROOT / "cli" / "inputs.py") if text.startswith("A scene file"))
    folders = set(re.findall(r"[a-z]+", scene.split(" folder: ")[1]))
    assert folders & set(VERBS) == {options.__name__.removesuffix("Options").lower() for options in IN_TIME}
    anchor = next(text for text in helps(ROOT / "aaplug" / "options" / "verbs.py") if text.startswith("Weight of the"))
    assert f"against {LOSS_WEIGHTS[1 / 4]:g} for 1/4 and {LOSS_WEIGHTS[1 / 2]:g} for" in anchor


def test_help_begins_with_examples_and_lists_each_verb_with_its_first_line_only(cli):
    _, out, _ = cli("--help")
    assert "aaplug convert scene.ply --cameras path/to/colmap -o converted.ply" in map(str.strip, out.splitlines())
    listed = " ".join(out.split())
    for name, command in VERBS.items():
        first, *rest = command.help.split("\n\n")
        assert f"{name} {first}" in listed
        assert not any(" ".join(text.split()) in listed for text in rest)


@pytest.mark.parametrize("verb", VERBS)
def test_help_of_a_verb_opens_with_when_to_use_it_and_when_another_and_shows_every_range(program, verb):
    text = program(f"{verb} --help")[1]
    usage, about = HEADING.split(text)[0].strip().split("\n", 1)
    assert usage.startswith(f"usage: aaplug {verb} ")
    first, when = about.strip().split("\n\n")
    assert first == VERBS[verb].help.splitlines()[0]
    assert any(re.search(rf"\b{other}\b", when) for other in VERBS if other != verb), when
    assert ("path file" in text) == (verb in ("render", "video"))
    assert "guides/" not in text, "a guide's file, which the wheel lacks"
    shown = "".join(text.split())
    assert not re.search(r"default:(True|False|None|inf)\)", shown), "of a switch"
    for option in VERBS[verb].options.values():
        if ".." in option.takes:
            assert f"{option.flags[0]}{option.metavar}".replace(" ", "") in shown


def test_render_shows_few_options_before_those_with_a_heading(cli):
    text = HEADING.split(cli("render --help")[1])
    assert text[0].startswith("usage: aaplug render [-h] [OPTIONS] [SCENE]\n")  # or a model folder, by -m
    headings, options = text[1::2], re.findall(r"(?m)^ {1,2}(-\w|--[a-z-]+|\[?[A-Z]+)\b", "".join(text[2:6:2]))
    assert headings[:3] == ["positional arguments", "options", "scene file options"]
    assert {"[SCENE", "-h", "-o", "--cameras", "--scale"} <= set(options)
    assert len(options) <= 15


def test_a_refused_word_ends_in_one_stop(cli):
    for words in ("", "evaluat", "bench --gaussians 10 --scale 1"):
        _, _, err = cli(words)
        assert "; see `aaplug" in err
        assert not re.search(r"\.;|---", err), err


def test_each_guide_is_listed_by_its_heading_and_printed_as_it_is(cli):
    listed = [line.split(maxsplit=1) for line in cli("guide")[1].splitlines()]
    headings = [[path.stem, path.read_text().splitlines()[0].removeprefix("# ")] for path in GUIDES]
    assert [[name, heading.strip()] for name, heading in listed] == headings
    for path in GUIDES:
        assert cli(f"guide {path.stem}") == (0, path.read_text(), "")


def test_a_guide_is_drawn_on_a_terminal_and_long_words_keep_their_ends(cli, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "60")
    _, out, _ = cli("guide viewers")
    assert "`" not in out
    assert "…" not in out


def test_texts_name_guides_that_are_there_and_not_their_files():
    sources = [*(ROOT / "aaplug").rglob("*.py"), *(ROOT / "cli").glob("*.py"), ROOT / "README.md", *GUIDES]
    named = re.findall(r"`aaplug guide (\w+)`", "".join(path.read_text() for path in sources))
    assert {"cluster", "formats", "viewers"} <= set(named) <= {path.stem for path in GUIDES}


def test_the_table_of_recipes_has_every_one_and_marks_those_for_comparison(cli, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    used, compared = cli("recipes")[1].split("For comparison:")
    facts = json.loads(cli("recipes --json")[1])
    assert [each["name"] for each in facts] == list(RECIPES)
    for each in facts:
        row = " +".join(re.escape(each[key]) for key in ("name", "cost", "when", "source"))
        assert re.search(rf"^{row} *$", compared if each["comparison"] else used, re.M), each["name"]
    assert [each["name"] for each in facts if not each["comparison"]] == names_of("recipe", comparisons=False)


@pytest.mark.parametrize("columns", ["60", "0", "7"])  # 0 and 7: terminals that do not know
def test_no_table_cuts_a_name_off(cli, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    shown = cli("recipes")[1]
    assert ("…" in shown, "matched" in shown) == (False, True)
