"""Every claim of the tables in formats.md names the tests that prove it; viewers.md has a row for each viewer.

Tests that guides name are there.
"""

import re
from pathlib import Path

import pytest

from aaplug.io.scenes import SCENE_FORMATS
from aaplug.methods.viewers import MOST_DEGREE, VIEWERS, Viewer
from tests.conftest import ROOT

TEXTS = [ROOT / "README.md", *sorted((ROOT / "examples").rglob("*.md"))]
ROWS = [
    line
    for line in (ROOT / "examples" / "guides" / "formats.md").read_text().splitlines()
    if line.startswith("|") and "---" not in line and "proven by" not in line
]
SCENES = [row for row in ROWS if row.count("|") == 6]


def _body(file: str, name: str) -> str:
    source = (ROOT / "tests" / file).read_text()
    found = re.search(rf"^def {name}\(.*?(?=^[a-z@#])", source + "\nend", re.MULTILINE | re.DOTALL)
    assert found is not None, name
    return found[0]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_each_row_of_the_table_of_formats_names_its_proof(row: str):
    """Which is there, as each test that a guide names."""
    assert re.search(r"`test_\w+\.py::test_\w+`", row.split("|")[-2]), row


@pytest.mark.parametrize("row", SCENES, ids=lambda row: row.split("|")[1].strip())
def test_each_row_of_scenes_proves_reading_writing_and_the_tag(row: str):
    """One test may prove several claims, but a format that can be written names a test that writes it."""
    _, _, _, written, tag, proofs, _ = row.split("|")
    bodies = [_body(file, name) for file, name in re.findall(r"`(test_\w+\.py)::(test_\w+)`", proofs)]
    assert any("read_scene" in body or "open_scene" in body for body in bodies)
    if written.strip() != "no":
        assert any("write_scene" in body or "through(" in body for body in bodies), proofs
    if tag.strip() != "the format has none":
        assert any("convention" in body for body in bodies), proofs


def test_each_test_that_a_guide_names_is_there():
    named = {
        (text.name, *proof) for text in TEXTS for proof in re.findall(r"`(test_\w+\.py)::(test_\w+)`", text.read_text())
    }
    assert len(named) > 60
    sources = {file: (ROOT / "tests" / file).read_text() for _, file, _ in named}
    assert not [
        proof for proof in sorted(named) if not re.search(rf"^def {proof[2]}\(", sources[proof[1]], re.MULTILINE)
    ]


def test_every_format_has_a_row():
    text = "\n".join(ROWS)
    assert len(ROWS) >= 20
    for format in SCENE_FORMATS.values():
        assert format.name in text.lower(), format.name


def row_of(viewer: Viewer) -> str:
    """A viewer's row of the table in viewers.md."""
    assert viewer.convention is not None
    cells = [
        viewer.program,
        viewer.choice,
        f"{viewer.convention.kernel:g} px²",
        "yes" if viewer.convention.compensated else "no",
        "any" if viewer.sh_degree == MOST_DEGREE else str(viewer.sh_degree),
        viewer.end,
        viewer.levels or "none",
        viewer.evidence,
    ]
    return f"| `{viewer.name}` | {' | '.join(cells)} |"


@pytest.mark.parametrize("viewer", VIEWERS.values(), ids=VIEWERS)
def test_each_viewer_has_its_row(viewer: Viewer):
    assert row_of(viewer) in (ROOT / "examples" / "guides" / "viewers.md").read_text().splitlines()


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.name)
def test_no_text_holds_a_placeholder(text: Path):
    assert re.findall(r"@[A-Z]+@", text.read_text()) == []
