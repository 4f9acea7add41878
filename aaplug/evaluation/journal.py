"""The journal of an evaluation: finished views on disk, so that an interrupted evaluation can continue.

A file of JSON lines: the request first, then one line per view, synced to disk once the view's images are stored.  A
line that was cut short is dropped and written again.  Numbers come back exactly, so a continued evaluation gives what
an uninterrupted one does.
"""

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from aaplug.evaluation.results import Measurement
from aaplug.system.errors import FormatError, OutputError, UsageError, listing, reason
from aaplug.system.locks import lock

JOURNAL = "progress.jsonl"
ANEW = "remove the file to start again"  # `overwrite` would start all scenes of a batch again

Fits = Callable[[int, Sequence[Measurement]], bool]


class Journal:
    """An open journal; a context manager.  views: measurements of the finished views, by their place in the request."""

    def __init__(
        self,
        path: str | PathLike[str] | None,
        request: Mapping[str, Any],
        resume: bool,
        fits: Fits = lambda view, measurements: True,
    ):
        """Continue the journal at `path` if `resume` is set and there is one; else start it with the first `add`.

        path: None keeps the views in memory alone.
        fits: True for the place and the measurements of a view that the request asks for.

        Raises UsageError if it is of another request or another process writes it, FormatError if it is damaged, and
        OutputError if it cannot be written.
        """
        self.views = dict[int, tuple[Measurement, ...]]()
        self._stream: BinaryIO | None = None
        self.path = None if path is None else Path(path)
        if self.path is not None:
            self._request = json.loads(json.dumps(request, allow_nan=False))
            if resume and self.path.exists():
                self._continue(self.path, fits)

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
            lines = [{"view": view, "measurements": [asdict(m) for m in measurements]}]
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

    def _continue(self, path: Path, fits: Fits) -> None:
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
                try:
                    view, measurements = line["view"], tuple(map(_measurement, line["measurements"]))
                    if type(view) is not int or view in self.views or not fits(view, measurements):
                        raise ValueError(line)
                except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
                    raise FormatError(path, f"its line {number} is damaged; {ANEW}") from error
                self.views[view] = measurements
            stack.pop_all()  # the stream stays open
            self._stream = stream


def check_request(path: Path, before: Mapping[str, Any], now: Mapping[str, Any], anew: str) -> None:
    """Refuse to continue what was asked for otherwise; path: where that is written.  anew: how to start again."""
    if changed := [*_changes(before, now)]:
        what = f"is of another request or another aaplug ({listing(changed)} changed since)"
        raise UsageError(str(path), f"{what}; repeat that request, or {anew}")


def _changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """The keys whose values differ; those of mappings with that of the mapping, such as `versions.torch`."""
    for key in dict.fromkeys((*now, *before)):
        old, new = before.get(key), now.get(key)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from (f"{key}.{inner}" for inner in _changes(old, new))
        elif old != new:
            yield key


def _measurement(line: Any) -> Measurement:
    """A measurement as it was written; raises TypeError or KeyError if it is none."""
    texts, numbers = (line["recipe"], line["view"], line["note"]), (line["scale"], line["samples"], line["seconds"])
    defined = [n for n in (line["evaluations"], *line["values"].values()) if n is not None]
    finite = all(type(n) in (int, float) and math.isfinite(n) for n in (*numbers, *defined))
    if not finite or not all(isinstance(text, str) for text in texts):
        raise TypeError(line)
    return Measurement(**line)


def _lock(stream: BinaryIO, path: Path) -> None:
    if lock(stream.fileno()) is False:
        raise UsageError(str(path), "another process is writing it")


@contextmanager
def _named_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(path, f"cannot be written: {reason(error)}") from error
