"""What an evaluation has finished, on disk as it goes, so that a killed one continues where it was.

A file of JSON lines: the request first, then one line a view, written through to the disk once the view's images are
in place.  A line that a kill tore is ignored and written again.  Numbers survive as they are, so that a continued
evaluation gives what an uninterrupted one does.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from aaplug.core.errors import OutputError, UsageError, listing
from aaplug.evaluation.results import Measurement


class Record:
    """An open record.  known: the measurements of the finished views, by their place in the request."""

    def __init__(self, path: Path, request: Mapping[str, Any], resume: bool):
        """A new record, made with the first view's line, or the one that `path` holds if `resume` asks for it.

        Raises:
            UsageError: it is the record of another request, or another process is writing it.
            OutputError: it cannot be written.
        """
        self.path, self.known = path, dict[int, tuple[Measurement, ...]]()
        self._request = json.loads(json.dumps(request, allow_nan=False))
        self._stream: BinaryIO | None = None
        if resume and path.exists():
            self._continue()

    def add(self, view: int, measurements: Sequence[Measurement]) -> None:
        """Note a finished view.

        Raises:
            UsageError: another process is writing the record.
            OutputError: it cannot be written.
        """
        with _worded(self.path):
            if self._stream is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._stream = self.path.open("ab")  # not emptied before it is ours
                _lock(self._stream, self.path)
                self._stream.truncate(0)
                self._write({"request": self._request})
            self._write({"view": view, "measurements": [asdict(m) for m in measurements]})

    def close(self) -> None:
        """Let others write."""
        if self._stream is not None:
            self._stream.close()

    def _continue(self) -> None:
        with _worded(self.path), ExitStack() as stack:
            stream = stack.enter_context(self.path.open("r+b"))
            _lock(stream, self.path)
            lines = _whole_lines(stream)
            if not lines:
                return
            _check_same(self.path, lines[0].get("request"), self._request)
            for line in lines[1:]:
                self.known[line["view"]] = tuple(Measurement(**m) for m in line["measurements"])
            stack.pop_all()  # it stays open
            self._stream = stream

    def _write(self, line: Mapping[str, Any]) -> None:
        assert self._stream is not None
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()
        os.fsync(self._stream.fileno())


@contextmanager
def _worded(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise OutputError(path, f"cannot be written: {reason}") from error


def _whole_lines(stream: BinaryIO) -> list[dict[str, Any]]:
    """The lines that were written whole; the stream stands after them and ends there."""
    stream.seek(0)
    found, end = list[dict[str, Any]](), 0
    for line in stream:
        if not line.endswith(b"\n"):
            break
        try:
            found.append(json.loads(line))
        except ValueError:  # a disk that was pulled can leave zeros
            break
        end += len(line)
    stream.seek(end)
    stream.truncate()
    return found


def _check_same(path: Path, before: Any, now: Mapping[str, Any]) -> None:
    before = before if isinstance(before, dict) else {}
    changed = [key for key in (*now, *before) if before.get(key) != now.get(key)]
    if changed:
        names = listing(list(dict.fromkeys(changed)))
        raise UsageError(
            str(path),
            f"is of another request ({names} changed since); ask as before, or start anew with --overwrite",
        )


def _lock(stream: BinaryIO, path: Path) -> None:
    """One process a record; the system lets go when that process ends, however it ends."""
    with suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise UsageError(str(path), "another process is writing it") from error
