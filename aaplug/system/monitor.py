"""Messages and progress of a long call."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Tell = Callable[[int, int], None]  # (done, in all)


class Monitor:
    """Receives messages and progress; this one ignores them.  The command line prints them."""

    def say(self, text: str) -> None:
        """Take one line of log."""

    @contextmanager
    def progress(self, what: str, unit: str) -> Iterator[Tell]:
        """Begin a task, such as ("rendering", "views"); the function it yields takes (done, in all)."""
        yield lambda done, total: None

    def working(self, workers: int) -> None:
        """Take the number of a cluster's workers, now and then while it works."""


SILENT = Monitor()
