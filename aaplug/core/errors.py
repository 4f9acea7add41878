"""What can go wrong for a user, each error saying where, what was expected, what was found and what to do.

Everything here reaches the terminal as one line and ends the program with exit code 2.  Our own mistakes are
`assert`s and are not caught.
"""

from collections.abc import Sequence
from os import PathLike


class AaplugError(Exception):
    """Any mistake in the user's input, worded for the user."""

    def __init__(self, where: str | PathLike[str], problem: str) -> None:
        self.where = str(where)
        self.problem = problem
        super().__init__(f"{self.where}: {problem}")

    def __reduce__(self) -> tuple[type["AaplugError"], tuple[str, str]]:
        """As the parts it was made of, so that it can come back from another process."""
        return type(self), (self.where, self.problem)


class FormatError(AaplugError):
    """A file is not what its format promises."""


class FrameError(AaplugError):
    """Scene and cameras do not belong together."""


class OutputError(AaplugError):
    """Nothing may or can be written there."""


class UsageError(AaplugError):
    """Options that contradict each other or name nothing."""


def listing(names: Sequence[str], most: int = 6) -> str:
    """Join names for a message, cut short where there are many."""
    shown = ", ".join(names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def reason(error: Exception) -> str:
    """Why a library or the system failed, in lower case: an OSError's own words without its number and path."""
    strerror = error.strerror if isinstance(error, OSError) else None
    return (strerror or str(error)).lower()
