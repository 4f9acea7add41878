"""Outputs appear whole or not at all, and never in place of an input."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext, suppress
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from aaplug.io.atomic import check_output, claimed, output_folder, replacing, writing
from aaplug.io.image_formats import Storage
from aaplug.io.layers import write_layers
from aaplug.io.scenes import write_scene
from aaplug.io.video import write_video
from aaplug.system import locks
from aaplug.system.errors import OutputError
from aaplug.system.locks import remove_left, scratch
from tests.conftest import exit_code, files_of_at_most, make_scene

OLD, NEW = b"old", b"new and longer"


@pytest.fixture
def output(tmp_path: Path) -> Path:
    path = tmp_path / "scene.ply"
    path.write_bytes(OLD)
    return path


def write(path: Path, content: bytes, overwrite: bool = False) -> None:
    with replacing(path, overwrite) as stream:
        stream.write(content)


def only_the_old_file_is_there(path: Path) -> bool:
    return path.read_bytes() == OLD and list(path.parent.iterdir()) == [path]


@pytest.fixture(params=["posix", "windows"])
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """POSIX, or Windows: without flock, and a file that a process has open is neither removed nor renamed."""

    def refusing(call: Callable[..., None]) -> Callable[..., None]:
        def called(*paths: str | Path) -> None:
            opened = set[str]()
            for descriptor in Path("/proc").glob("[0-9]*/fd/*"):
                with suppress(OSError):  # it has gone
                    opened.add(os.readlink(descriptor))
            if any(os.path.realpath(path) in opened for path in paths):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
            call(*paths)

        return called

    if request.param == "windows":
        monkeypatch.setitem(sys.modules, "fcntl", None)
        monkeypatch.setattr(locks, "OPEN_IS_HELD", True)
        for name in ("replace", "unlink"):
            monkeypatch.setattr(os, name, refusing(getattr(os, name)))
    return request.param


@pytest.mark.usefixtures("system")
def test_an_existing_file_needs_overwrite(output: Path):
    for refused in (lambda: write(output, NEW), lambda: check_output(output, False)):
        with pytest.raises(OutputError, match=r"exists.*pass `overwrite`"):
            refused()
    check_output(output.parent / "new", False, [output])
    check_output(output, True, [output.parent / "missing"])
    assert only_the_old_file_is_there(output)
    write(output, NEW, overwrite=True)
    assert output.read_bytes() == NEW


@pytest.mark.usefixtures("system")
@pytest.mark.parametrize("failure", [KeyboardInterrupt, ValueError])
def test_whatever_interrupts_leaves_the_old_file(output: Path, failure: type[BaseException]):
    def interrupted() -> None:
        with replacing(output, overwrite=True) as stream:
            stream.write(NEW)
            assert output.read_bytes() == OLD
            raise failure

    with pytest.raises(failure):
        interrupted()
    assert only_the_old_file_is_there(output)


@pytest.mark.parametrize("call", ["fsync", "replace", None])
def test_a_full_disk_is_one_line_and_leaves_the_old_file(output: Path, call: str | None, monkeypatch):
    """As a call says, or half way while the file is written."""
    if call:
        monkeypatch.setattr(os, call, Mock(side_effect=OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))))
    said = rf"scene\.ply: cannot be written: {'no space left' if call else 'file too large'}"
    with nullcontext() if call else files_of_at_most(1 << 16), pytest.raises(OutputError, match=said):
        write(output, bytes(1 << 20), overwrite=True)
    assert only_the_old_file_is_there(output)


NOISE = torch.rand(20, 100, 100, 3)
WRITERS = {
    **dict.fromkeys(("a.usda", "a.usdc", "a.usdz"), ("pxr", lambda path: write_scene(path, make_scene(200)))),
    "a.exr": ("OpenEXR", lambda path: write_layers(path, {"rgb": NOISE[0]}, Storage.of(path))),
    **dict.fromkeys(("a.webm", "a.mp4"), ("av", lambda path: write_video(path, NOISE, 25.0))),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_that_a_library_meets_is_one_line(tmp_path: Path, name: str):
    package, write = WRITERS[name]
    pytest.importorskip(package)
    said = rf"{name}: cannot be written: file too large$"
    with files_of_at_most(10_000), pytest.raises(OutputError, match=said):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_permissions_follow_the_umask_and_a_link_stays_a_link(output: Path, tmp_path: Path):
    (link := tmp_path / "link").symlink_to(output)
    old = os.umask(0o027)
    try:
        write(link, NEW, overwrite=True)
    finally:
        os.umask(old)
    assert link.is_symlink()
    assert output.read_bytes() == NEW
    assert output.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("scene.ply/out.ply", "cannot be written: .*scene.ply is no folder"),
        ("scene.ply/deeper/out.ply", "cannot be written: .*scene.ply is no folder"),
        (".", "is a folder"),
        ("x" * 300, "cannot be written"),
        ("nul\0", "cannot be written"),
        ("pipe", "not an ordinary file"),
        ("loop", "is a link that leads to itself"),
    ],
)
def test_impossible_outputs_are_refused(output: Path, name: str, problem: str):
    os.mkfifo(output.parent / "pipe")
    (output.parent / "loop").symlink_to("loop")
    path = output.parent / name
    for refused in (lambda: write(path, NEW, overwrite=True), lambda: check_output(path, True)):
        with pytest.raises(OutputError, match=problem):
            refused()
    assert sorted(output.parent.iterdir()) == [output.parent / "loop", output.parent / "pipe", output]
    assert output.read_bytes() == OLD


def test_a_missing_folder_is_made_and_removed_if_nothing_is_written(tmp_path: Path):
    path = tmp_path / "new" / "deeper" / "out.ply"
    for claim in (writing(path, lambda: check_output(path, False), ()), nullcontext()):
        with pytest.raises(ZeroDivisionError), claim, replacing(path, False) as stream:
            stream.write(b"half" * (1 // 0))
        assert not list(tmp_path.iterdir())
    write(path, NEW, overwrite=False)
    assert path.read_bytes() == NEW


def test_an_input_is_never_an_output(output: Path):
    folder = output.parent
    (folder / "symlink").symlink_to(output)
    os.link(output, folder / "hard link")
    for other in (folder / ".." / folder.name / output.name, folder / "symlink", folder / "hard link"):
        with pytest.raises(OutputError, match="is also the input"):
            check_output(other, True, [folder / "missing", output])


def test_files_without_numbers_are_told_apart_by_name(output: Path, monkeypatch: pytest.MonkeyPatch):
    (other := output.parent / "other").touch()
    (link := output.parent / "link").symlink_to(other)
    stat = os.stat
    monkeypatch.setattr(os, "stat", lambda *path, **how: os.stat_result([stat(*path, **how)[0], 0, *[0] * 8]))
    check_output(output, True, [other])
    with pytest.raises(OutputError, match="is also the input"):
        check_output(link, True, [other])


@pytest.mark.parametrize("at", ["fsync", "replace"])
def test_kill_9_before_the_rename_leaves_the_old_file(output: Path, at: str):
    def killed() -> None:
        setattr(os, at, lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        write(output, NEW * 1000, overwrite=True)

    assert exit_code(killed) == -signal.SIGKILL
    assert output.read_bytes() == OLD
    (torn,) = (p for p in output.parent.iterdir() if p != output)
    assert torn.name.startswith(".aaplug-")  # hidden, and never taken for a scene
    write(output, NEW, overwrite=True)
    assert output.read_bytes() == NEW


CLAIM = """
import sys, time
from pathlib import Path
from aaplug.io.atomic import claimed, replacing
path = Path(sys.argv[1])
with claimed(path), replacing(path / "file", False) as stream:
    stream.write(b"half")
    print("ready", flush=True)
    time.sleep(60)
"""


@pytest.mark.usefixtures("system")
def test_an_output_is_written_by_one_process_and_a_killed_one_leaves_nothing(tmp_path: Path):
    words = [sys.executable, "-c", CLAIM, str(tmp_path)]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"ready\n"
        with pytest.raises(OutputError, match="is being written by another process"), claimed(tmp_path):
            pass
        remove_left.cache_clear()
        remove_left(tmp_path)
        assert len(list(tmp_path.iterdir())) == 2  # the claim and the temporary file are held
        other.kill()
    assert len(list(tmp_path.iterdir())) == 2
    remove_left.cache_clear()
    with claimed(tmp_path):
        write(tmp_path / "file", NEW)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_killed_process_refuses_nothing_where_no_lock_tells(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def work() -> None:
        with claimed(tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)

    assert exit_code(work) == -signal.SIGKILL
    monkeypatch.setattr(fcntl, "flock", Mock(side_effect=OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))))
    with claimed(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_only_what_is_surely_ours_is_removed(tmp_path: Path):
    mine = [tmp_path / name for name in ("aaplug-notes.txt", ".aaplug-notes", "aaplug-scratch-plan.txt")]
    for path in mine:
        path.touch()
    (tmp_path / "aaplug-mine").mkdir()
    (tmp_path / "aaplug-scratch-mine").mkdir()  # without the mark
    os.mkfifo(tmp_path / ".aaplug-0123456789abcdef")
    left = tmp_path / "aaplug-scratch-left"
    left.mkdir()
    (left / "aaplug.lock").touch()
    (tmp_path / ".aaplug-00000000000000ff.tmp").touch()
    remove_left.cache_clear()
    before = set(tmp_path.iterdir())
    remove_left(tmp_path)
    with scratch(str(tmp_path)) as folder:
        assert folder.exists()
    assert before - set(tmp_path.iterdir()) == {left, tmp_path / ".aaplug-00000000000000ff.tmp"}


def test_a_folder_that_nothing_was_written_to_is_removed(tmp_path: Path):
    with pytest.raises(ValueError, match="failed"), output_folder(tmp_path / "a" / "b"):
        raise ValueError("failed")
    assert list(tmp_path.iterdir()) == []
    kept = tmp_path / "a" / "b" / "kept"
    with pytest.raises(FileExistsError), output_folder(kept.parent):
        [kept.touch(exist_ok=False) for _ in range(2)]
    assert kept.exists()
