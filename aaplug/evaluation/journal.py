"""The journal of an evaluation: finished views on disk, so that an interrupted evaluation can continue.

A file of JSON lines: the request first, then one line per view with its hash, synced to disk once the view's images are
stored.  A line that was cut short is dropped and written again.  Numbers come back exactly, so a continued evaluation
gives what an uninterrupted one does.
"""

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from aaplug.evaluation.results import Measurement
from aaplug.system.digests import check_request, digest_of_values
from aaplug.system.errors import FormatError, OutputError, UsageError, reason
from aaplug.system.locks import lock

JOURNAL = "progress.jsonl"
HASH = "sha256"  # of what else a line holds
ANEW = "remove the file to start again"  # `overwrite` would start all scenes of a batch again


class Journal:
    """An open journal; a context manager.  views: measurements of the finished views, by their place in the request."""

    def __init__(self, path: str | PathLike[str] | None, request: Mapping[str, Any], resume: bool):
        """Continue the journal at `path` if `resume` is set and there is one; else start it with the first `add`.

        path: None keeps the views in memory alone.

        Raises UsageError if it is of another request or another process writes it, FormatError if it is damaged, and
        OutputError if it cannot be written.
        """
        self.views = dict[int, tuple[Measurement, ...]]()
        self._stream: BinaryIO | None = None
        self.path = None if path is None else Path(path)
        if self.path is not None:
            self._request = json.loads(json.dumps(request, allow_nan=False))
            if resume and self.path.exists():
                self._continue(self.path)

    def __enter__(self) -> "Journal":
        return self

    def __exit__(self, *error: object) -> None:
        """Close the file, which lets other processes write it."""
        if self._stream is not None:
            self._stream.close()

    def add(self, view: int, measurements: Sequence[Measurement]) -> None:
        """Add a finished view; raises as the constructor does."""
        self.views[view] = tuple(measurements)
        if self.path is None:
            return
        with _named_errors(self.path):
            line = {"view": view, "measurements": [asdict(m) for m in measurements]}
            lines = [line | {HASH: digest_of_values(line)}]
            if self._stream is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self._stream = self.path.open("ab")  # it is emptied only after it is locked
                _lock(self._stream, self.path)
                self._stream.truncate(0)
                lines = [{"request": self._request}, *lines]
            for line in lines:
                self._stream.write(json.dumps(line, allow_nan=False).encode() + b"\n")
                self._stream.flush()
                os.fsync(self._stream.fileno())

    def _continue(self, path: Path) -> None:
        """Read the finished views, and keep the file open where it is of this request."""
        with _named_errors(path), ExitStack() as stack:
            stream = stack.enter_context(path.open("r+b"))
            _lock(stream, path)
            lines, end = list[Any](), 0
            for text in stream:
                try:
                    lines.append(json.loads(text.removesuffix(b"\n") if text.endswith(b"\n") else b""))
                except ValueError:  # cut short, or the zeros that a power loss can leave
                    break
                end += len(text)
            stream.seek(end)
            stream.truncate()
            if not lines:
                return
            first, now = lines[0], self._request
            before = first.get("request") if isinstance(first, dict) else None
            check_request(path, before if isinstance(before, dict) else {}, now, ANEW)
            for number, line in enumerate(lines[1:], start=2):
                whole = isinstance(line, dict) and line.pop(HASH, None) == digest_of_values(line)
                if not whole or line["view"] in self.views:
                    raise FormatError(path, f"its line {number} is damaged, or of another aaplug; {ANEW}")
                self.views[line["view"]] = tuple(Measurement(**each) for each in line["measurements"])
            stack.pop_all()  # the stream stays open
            self._stream = stream


def _lock(stream: BinaryIO, path: Path) -> None:
    if lock(stream.fileno()) is False:
        raise UsageError(str(path), "another process is writing it")


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(path, f"cannot be written: {reason(error)}") from error
