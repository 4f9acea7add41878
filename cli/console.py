"""What the user sees: log and progress on stderr, data on stdout."""

import json
import logging
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from aaplug.core.errors import printable
from aaplug.core.monitor import Monitor, Tell

LINE_SECONDS = 10.0  # between progress lines where there is no terminal

log = Console(stderr=True, highlight=False, soft_wrap=True)
out = Console(highlight=False)


def plain(text: str) -> str:
    """The text for the log: on one line, without control characters and markup."""
    return escape(printable(text))


class _Warnings(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        log.print(f"[yellow]warning:[/] {plain(record.getMessage())}")


def set_up() -> None:
    """Send the library's warnings to the log, and write names that are not UTF-8 in escaped form."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    logger = logging.getLogger("aaplug")
    logger.handlers, logger.propagate = [_Warnings()], False


def refuse(problem: str) -> None:
    """One line of error."""
    log.print(f"[red]error:[/] {plain(problem)}")


class Terminal(Monitor):
    """Prints messages and progress on stderr: a bar on a terminal, a line now and then elsewhere."""

    def say(self, text: str) -> None:
        """One line of log."""
        log.print(plain(text))

    @contextmanager
    def progress(self, what: str, unit: str) -> Iterator[Tell]:
        """Show progress and the time left."""
        if not log.is_terminal:
            yield _lines(what, unit)
            return
        columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TextColumn(unit))
        with Progress(*columns, TimeRemainingColumn(), console=log, transient=True) as bar:
            task = bar.add_task(what, total=None)
            yield lambda done, total: bar.update(task, completed=done, total=total)


TERMINAL = Terminal()
say = TERMINAL.say


def print_json(data: Any) -> None:
    """One object on stdout, strict JSON."""
    sys.stdout.write(json.dumps(data, indent=1, allow_nan=False) + "\n")


def _lines(what: str, unit: str) -> Tell:
    """Progress for logs: a line every LINE_SECONDS and one at the end."""
    started = told = time.monotonic()

    def tell(done: int, total: int) -> None:
        nonlocal told
        now = time.monotonic()
        if done == total or now - told >= LINE_SECONDS:
            left = (now - started) / max(done, 1) * (total - done)
            eta = f", about {left:.0f} s left" if 0 < done < total else ""
            say(f"{what}: {done} of {total} {unit}{eta}")
            told = now

    return tell
