"""The journal of an evaluation: what survives an interruption, and what it refuses."""

import pytest

from aaplug.evaluation.journal import Journal
from aaplug.evaluation.results import Measurement
from aaplug.system.errors import FormatError, OutputError, UsageError

REQUEST = {"views": 3, "scales": [1.0, 0.1], "versions": {"aaplug": "1", "torch": "2"}}


def measured(view: str) -> Measurement:
    return Measurement("auto", 0.1, view, {"PSNR": 1 / 3, "SSIM": None}, 2, 0.125, "note", 7)


@pytest.fixture
def path(tmp_path):
    """A journal of two finished views."""
    with Journal(tmp_path / "r" / "progress.jsonl", REQUEST, resume=False) as journal:
        for i, name in enumerate("ab"):
            journal.add(i, [measured(name)])
    return journal.path


def test_what_is_finished_comes_back_to_the_bit_and_zeros_of_a_lost_disk_do_not(path):
    whole = path.read_bytes()
    path.write_bytes(whole + b"\0" * 50 + b"\n")
    with Journal(path, REQUEST, resume=True) as journal:
        assert journal.views == {0: (measured("a"),), 1: (measured("b"),)}
    assert path.read_bytes() == whole


@pytest.mark.parametrize(("end", "views"), [(-1, "a"), (-20, "a"), (-60, "a"), (10, "")])
def test_a_torn_line_is_forgotten_and_written_again(path, end, views):
    whole = path.read_bytes()
    path.write_bytes(whole[:end])
    with Journal(path, REQUEST, resume=True) as journal:
        assert len(journal.views) == len(views)
        for i, name in list(enumerate("ab"))[len(views) :]:
            journal.add(i, [measured(name)])
    assert path.read_bytes() == whole


def test_another_request_is_refused_by_what_changed_until_the_journal_is_removed(path):
    other = {"scales": [1.0], "views": 3, "versions": {"aaplug": "1", "torch": "3"}}
    with pytest.raises(UsageError, match=r"another aaplug \(scales, versions.torch changed.* or remove the file"):
        Journal(path, other, resume=True)
    path.unlink()
    assert not Journal(path, other, resume=True).views


def test_without_resume_it_starts_anew(path):
    with Journal(path, REQUEST | {"views": 9}, resume=False) as journal:
        journal.add(0, [measured("c")])
    assert len(path.read_text().splitlines()) == 2


def test_two_processes_do_not_share_a_journal(path):
    with Journal(path, REQUEST, resume=True), pytest.raises(UsageError, match="another process"):
        Journal(path, REQUEST, resume=True)


def test_nothing_is_made_before_the_first_view_and_a_place_that_cannot_be_written_is_named(tmp_path):
    with Journal(tmp_path / "deep" / "progress.jsonl", REQUEST, resume=True):
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    journal = Journal(tmp_path / "file" / "progress.jsonl", REQUEST, resume=False)
    with pytest.raises(OutputError, match=r"progress\.jsonl: cannot be written"):
        journal.add(0, [measured("a")])


DAMAGED = ("{}", "[]", '{"view": 0}', '{"view": 0, "measurements": [{}]}', '{"view": [], "measurements": []}')


@pytest.mark.parametrize("line", DAMAGED)
def test_a_line_that_is_no_measurement_is_refused(tmp_path, line):
    path = tmp_path / "progress.jsonl"
    path.write_text('{"request": {}}\n' + line + "\n")
    with pytest.raises(FormatError, match="its line 2 is damaged"):
        Journal(path, {}, resume=True)
