"""The journal of an evaluation: finished views on disk, so that an interrupted evaluation can continue.

A file of JSON lines: the request first, then one line per view, synced to disk once the view's images are stored.  A
line that was cut short is dropped and written again.  Numbers come back exactly, so a continued evaluation gives what
an uninterrupted one does.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO

from aaplug.core.errors import FormatError, OutputError, UsageError, listing, reason
from aaplug.core.locks import lock
from aaplug.evaluation.results import CEILING, Measurement, Report


class Journal:
    """An open journal; a context manager.  known: measurements of the finished views, by their place in the request."""

    def __init__(self, path: Path, request: Mapping[str, Any], resume: bool):
        """Continue the journal at `path` if `resume` is set and there is one; else start it with the first `add`.

        Raises:
            UsageError: the journal is of another request, or another process is writing it.
            OutputError: it cannot be written.
        """
        self.path, self.known = path, dict[int, tuple[Measurement, ...]]()
        self._request = json.loads(json.dumps(request, allow_nan=False))
        self._stream: BinaryIO | None = None
        if resume and path.exists():
            self._continue()

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *error: object) -> None:
        """Close the file, which lets other processes write it."""
        if self._stream is not None:
            self._stream.close()

    def add(self, view: int, measurements: Sequence[Measurement]) -> None:
        """Add a finished view; raises as the constructor does."""
        with _worded(self.path):
            if self._stream is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._stream = self.path.open("ab")  # emptied only after it is locked
                _lock(self._stream, self.path)
                self._stream.truncate(0)
                self._write({"request": self._request})
            self._write({"view": view, "measurements": [asdict(m) for m in measurements]})

    def _continue(self) -> None:
        with _worded(self.path), ExitStack() as stack:
            stream = stack.enter_context(self.path.open("r+b"))
            _lock(stream, self.path)
            lines = _whole_lines(stream)
            if not lines:
                return
            first, now = lines[0], self._request
            before = first.get("request") if isinstance(first, dict) else None
            before = before if isinstance(before, dict) else {}
            changed = dict.fromkeys(key for key in (*now, *before) if before.get(key) != now.get(key))
            if changed:
                what = f"is of another request ({listing(list(changed))} changed since)"
                raise UsageError(str(self.path), f"{what}; repeat that request, or start again with `overwrite`")
            for number, line in enumerate(lines[1:], start=2):
                view, found = self._measured(number, line)
                self.known[view] = found
            stack.pop_all()  # keeps the stream open
            self._stream = stream

    def _measured(self, number: int, line: Any) -> tuple[int, tuple[Measurement, ...]]:
        """A finished view and its measurements, of the line of this number."""
        try:
            view, measurements = int(line["view"]), tuple(map(_measurement, line["measurements"]))
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
            problem = f"its line {number} is damaged; start again with `overwrite`"
            raise FormatError(self.path, problem) from error
        return view, measurements

    def _write(self, line: Mapping[str, Any]) -> None:
        assert self._stream is not None
        self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._stream.flush()
        os.fsync(self._stream.fileno())


def read_report(path: Path) -> Report:
    """The report of a finished evaluation, from its journal, with the numbers that it was written with.

    Raises:
        FormatError: there is no journal, it is damaged, or views are missing.
    """
    try:
        with path.open("rb") as stream:
            request, *lines = [json.loads(line) for line in stream if line.endswith(b"\n")]
        request = request["request"]
        known = {int(line["view"]): tuple(map(_measurement, line["measurements"])) for line in lines}
        rows, scales, views = [CEILING, *request["recipes"]], request["scales"], request["views"]
        found = [m for view in range(views) for m in known[view]]
        found.sort(key=lambda m: (rows.index(m.recipe), scales.index(m.scale)))
    except OSError as error:
        raise FormatError(path, f"cannot be read: {reason(error)}") from error
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise FormatError(path, "is damaged or of an unfinished evaluation; continue that with --resume") from error
    return Report(tuple(found), request)


def _measurement(line: Any) -> Measurement:
    """A measurement as it was written; raises TypeError or KeyError if it is none."""
    texts, values = (line["recipe"], line["view"], line["note"]), line["values"]
    numbers = (line["scale"], line["samples"], line["seconds"], *(v for v in values.values() if v is not None))
    if not all(isinstance(text, str) for text in texts) or not all(isinstance(n, int | float) for n in numbers):
        raise TypeError(line)
    return Measurement(**line)


@contextmanager
def _worded(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(path, f"cannot be written: {reason(error)}") from error


def _whole_lines(stream: BinaryIO) -> list[Any]:
    """The complete lines; cuts the file after them."""
    stream.seek(0)
    found, end = list[Any](), 0
    for line in stream:
        if not line.endswith(b"\n"):
            break
        try:
            found.append(json.loads(line))
        except ValueError:  # a power loss can leave zeros
            break
        end += len(line)
    stream.seek(end)
    stream.truncate()
    return found


def _lock(stream: BinaryIO, path: Path) -> None:
    """Lock the journal for this process; the system releases the lock when the process ends."""
    if lock(stream.fileno()) is False:
        raise UsageError(str(path), "another process is writing it")
