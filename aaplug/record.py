"""What an evaluation has finished, on disk as it goes, so that a killed one continues where it was.

A file of JSON lines: the request first, then one line a view, written through to the disk once the view's images are
in place.  A line that a kill tore is ignored and written again.  Numbers survive as they are, so that a continued
evaluation gives what an uninterrupted one does.
"""

import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from aaplug.errors import OutputError, UsageError, listing
from aaplug.report import Measurement


class Record:
    """An open record.  known: the measurements of the finished views, by their place in the request."""

    def __init__(self, path: Path, request: Mapping[str, Any], resume: bool):
        """Start a record, or continue the one that `path` holds if that is asked for and it is of the same request.

        Raises:
            UsageError: it is the record of another request, or another process is writing it.
            OutputError: it cannot be written.
        """
        self.path, self.known = path, dict[int, tuple[Measurement, ...]]()
        request = json.loads(json.dumps(request, allow_nan=False))
        try:
            self._stream = open(path, "r+b" if path.exists() else "x+b")
            _lock(self._stream, path)
            first, *rest = _whole_lines(self._stream) if resume else (None,)
            if first is None:
                self._stream.seek(0)
                self._stream.truncate()
                self._write({"request": request})
                return
            _check_same(path, first.get("request"), request)
            for line in rest:
                self.known[line["view"]] = tuple(Measurement(**m) for m in line["measurements"])
        except OSError as error:
            raise OutputError(path, f"cannot be written: {(error.strerror or '').lower()}") from error

    def add(self, view: int, measurements: Sequence[Measurement]) -> None:
        """Note a finished view.

        Raises:
            OutputError: it cannot be written.
        """
        try:
            self._write({"view": view, "measurements": [asdict(m) for m in measurements]})
        except OSError as error:
            raise OutputError(
                self.path, f"cannot be written: {(error.strerror or '').lower()}"
            ) from error

    def close(self) -> None:
        """Let others write."""
        self._stream.close()

    def _write(self, line: Mapping[str, Any]) -> None:
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()
        os.fsync(self._stream.fileno())


def _whole_lines(stream: BinaryIO) -> tuple[dict[str, Any] | None, ...]:
    """The lines that were written whole; the stream stands after them and ends there.  None where there are none."""
    stream.seek(0)
    found, end = [], 0
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
    return tuple(found) or (None,)


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
