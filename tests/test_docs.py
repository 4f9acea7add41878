"""What the documents promise is what tests prove."""

import re
from pathlib import Path

import pytest

from aaplug.io.scenes import FORMATS

ROOT = Path(__file__).resolve().parents[1]
ROWS = [
    line
    for line in (ROOT / "docs" / "formats.md").read_text().splitlines()
    if line.startswith("|") and "---" not in line and "proven by" not in line
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip())
def test_each_row_of_the_table_of_formats_names_its_proof(row: str):
    proof = re.search(r"`(test_\w+\.py)::(test_\w+)` \|$", row)
    assert proof is not None, row
    source = (ROOT / "tests" / proof[1]).read_text()
    assert re.search(rf"^def {proof[2]}\(", source, re.MULTILINE), proof[2]


def test_every_format_has_a_row():
    text = "\n".join(ROWS)
    assert len(ROWS) >= 20
    for format in FORMATS:
        assert format.name in text.lower(), format.name
