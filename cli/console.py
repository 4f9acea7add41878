"""The program's output: log and progress on stderr, data on stdout."""

import logging
import os
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from io import TextIOWrapper
from typing import TYPE_CHECKING, Any

from aaplug.system.errors import counted, printable
from aaplug.system.monitor import Monitor, Tell

LINE_SECONDS = 10.0  # between progress lines where there is no terminal
GAP = 2  # characters between the columns of a table
MIN_COLUMNS = 8  # of a terminal that knows its width; with fewer, help is never done
MAX_COLUMNS = 10_000  # characters of a line

if TYPE_CHECKING:
    from rich.console import Console


@cache
def log() -> "Console":
    """The log on stderr.  Importing rich takes a tenth of a second, which help does without."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=True)


def show(things: Iterable[Any]) -> None:
    """Print tables and lines of text on stdout."""
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table

    for each in things:
        if isinstance(each, str):
            print(printable(each))
            continue
        console = Console(highlight=False)
        if isinstance(each, Table) and any(column.no_wrap for column in each.columns):
            # these are numbers, of which rich leaves digits out to fit
            least = Measurement.get(console, console.options.update(width=MAX_COLUMNS), each).minimum
            console.width = max(console.width, least)
        with console.capture() as drawn:  # rich would end the program where the reader of stdout has gone
            console.print(each)
        print(drawn.get(), end="")


def table(rows: Iterable[Sequence[str]], headings: Sequence[str] = ()) -> Any:
    """Texts in columns; no word is broken where the longest words of the columns fit side by side.

    Widths are those of CSS's automatic table layout.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    grid = Table(*headings, show_header=bool(headings), box=None, pad_edge=False)
    rows = list(rows)
    for row in rows:
        grid.add_row(*(Text("\n".join(map(printable, cell.split("\n")))) for cell in row))
    columns = [[*cells] for cells in zip(*([headings] if headings else []), *rows, strict=True)]
    least = [max(len(word) for cell in cells for word in [*cell.split(), ""]) for cells in columns]
    most = [max(map(len, "\n".join(cells).split("\n"))) for cells in columns]
    spare = Console().width - GAP * (len(columns) - 1) - sum(least)
    for column, low, high in zip(grid.columns, least, most, strict=True):
        column.overflow = "fold"  # a long name keeps its end
        if 0 <= spare < sum(most) - sum(least):
            column.width = low + (high - low) * spare // (sum(most) - sum(least))
    return grid


@contextmanager
def quiet() -> Iterator[None]:
    """A block that tells nothing on stderr."""
    before, log().quiet = log().quiet, True
    try:
        yield
    finally:
        log().quiet = before


def _print(text: str, heading: str = "", style: str = "") -> None:
    """One line of log as it is, but for control characters; heading: its first word, in a style."""
    from rich.text import Text

    log().print(Text.assemble((heading, style), printable(text)))


class _Warnings(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        _print(record.getMessage(), "warning: ", "yellow")


def set_up() -> None:
    """Send the library's warnings to the log, and write names that are not UTF-8 in escaped form."""
    columns = os.environ.get("COLUMNS", "")
    if columns.isdecimal() and int(columns) < MIN_COLUMNS:
        del os.environ["COLUMNS"]
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    logger = logging.getLogger("aaplug")
    logger.handlers, logger.propagate = [_Warnings()], False
    logging.getLogger("matplotlib").setLevel(logging.ERROR)  # its folder for fonts is no matter of the user's


def refuse(problem: str) -> None:
    """One line of error."""
    _print(problem, "error: ", "red")


class Terminal(Monitor):
    """Prints messages and progress on stderr: a bar on a terminal, a line now and then elsewhere."""

    _workers = ""  # that share the work, in words

    def working(self, workers: int) -> None:
        """Tell it with the progress."""
        self._workers = f", {counted(workers, 'worker')}"

    def say(self, text: str) -> None:
        """One line of log."""
        _print(text)

    @contextmanager
    def progress(self, what: str, unit: str) -> Iterator[Tell]:
        """Show progress, rate, workers and the time left."""
        started: tuple[float, int] | None = None
        told = time.monotonic()

        def pace(done: int) -> tuple[float, str]:
            """How many are done a second since the first call, as what an earlier run did does not count; and words."""
            nonlocal started
            now = time.monotonic()
            since, before = started = started or (now, done)
            rate = (done - before) / (now - since) if now > since else 0.0
            words = f", {rate:,{'.3g' if rate < 100 else '.0f'}} a second" if rate else ""
            return rate, words + self._workers

        def tell_log(done: int, total: int) -> None:
            nonlocal told
            now, (rate, words) = time.monotonic(), pace(done)
            if total and (done == total or now - told >= LINE_SECONDS):
                eta = f", about {(total - done) / rate:.0f} s left" if rate and done < total else ""
                all_of = counted(total, unit[:-1]) if unit.endswith("s") else f"{total} {unit}"
                say(f"{what}: {done:,} of {all_of}{words}{eta}")
                told = now

        if not log().is_terminal:
            yield tell_log
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        named = TextColumn("{task.fields[what]}", markup=False)  # a name may look like markup, or like a field
        columns = (named, BarColumn(), MofNCompleteColumn(), TextColumn("{task.description}"))
        with Progress(*columns, TimeRemainingColumn(), console=log(), transient=True) as bar:
            task = bar.add_task(unit, total=None, what=printable(what))
            yield lambda done, total: bar.update(
                task, completed=done, total=total, description=f"{unit}{pace(done)[1]}"
            )


TERMINAL = Terminal()
say = TERMINAL.say
