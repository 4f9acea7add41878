"""What --help says: an example, whole lines, and no word that belongs elsewhere."""

import ast
import re
from pathlib import Path

import pytest

from tests.test_cli import cli, dataset  # noqa: F401  (fixtures)

ROOT = Path(__file__).resolve().parents[1]
FILES = [*sorted((ROOT / "aaplug" / "options").glob("*.py")), *sorted((ROOT / "cli").glob("*.py"))]


def helps(file: Path) -> list[str]:
    """The docstrings of a file's options: strings that follow a field."""
    classes = [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.ClassDef)]
    pairs = [pair for node in classes for pair in zip(node.body, node.body[1:], strict=False)]
    return [
        after.value.value
        for field, after in pairs
        if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    ]


def test_the_options_are_found():
    assert sum(len(helps(file)) for file in FILES) > 60


@pytest.mark.parametrize("file", FILES, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_an_option_is_told_in_one_line(file):
    """The parser keeps the ends of a docstring's lines, which then fall anywhere."""
    assert [text for text in helps(file) if "\n" in text] == []


def test_help_begins_with_examples(cli):  # noqa: F811
    _, out, _ = cli("--help")
    lines = [line.strip() for line in out.splitlines()]
    assert "aaplug convert scene.ply --cameras path/to/colmap -o converted.ply" in lines


def test_only_a_video_has_a_path_file(cli):  # noqa: F811
    assert "path file" not in cli("render --help")[1]
    assert "path file" in cli("video --help")[1]


def test_a_refused_word_ends_in_one_stop(cli):  # noqa: F811
    for words in ("", "evaluat", "bench --gaussians 10 --scale 1"):
        _, _, err = cli(words)
        assert "; see `aaplug" in err
        assert not re.search(r"\.;|---", err), err
