"""Errors of users; each says where it is, what was expected, what is there and what to do.

Everything here reaches the terminal as one line and ends the program with exit code 2.  Our own mistakes are
`assert`s and are not caught.
"""

import difflib
import errno
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from traceback import walk_tb
from types import FrameType
from unicodedata import category

MAX_VALUE_CHARACTERS = 60  # characters of a refused value in a message
RESUME_OR_OVERWRITE = "continues a run, and `overwrite` starts anew; give one"
IS_COMPLETE = "is of a run that is complete: nothing is left to resume; `overwrite` starts anew"
START_AGAIN = "start again with `overwrite`, not `resume`"  # where what is there cannot be continued
SPACE = "Zs"  # Unicode's category of spaces, such as the ideographic one
VOWELS = tuple("aeiou")  # that a word begins with which takes "an"
# In a RuntimeError for lack of memory: torch's words, on Linux and elsewhere, and the last of a compiled kernel's.
MEMORY_WORDS = ("can't allocate memory", "not enough memory", "out of memory", "API call failed")
NO_THREAD = "can't start new thread"  # Python's words for a lack of threads
FULL = (errno.ENOSPC, errno.EFBIG, errno.EDQUOT)  # what a full disk is, or a limit on files


class AaplugError(Exception):
    """Any mistake in the user's input, worded for the user."""

    def __init__(self, where: str | PathLike[str], problem: str) -> None:
        self.where = str(where)
        self.problem = problem
        super().__init__(f"{self.where}: {problem}")

    def __reduce__(self) -> tuple[type["AaplugError"], tuple[str, str]]:
        """Return the parts that it is made of, so that it can come back from another process."""
        return type(self), (self.where, self.problem)


class FormatError(AaplugError):
    """A file is not what its format promises."""


class FrameError(AaplugError):
    """Scene and cameras do not belong together."""


class OutputError(AaplugError):
    """Nothing may or can be written there."""


class UsageError(AaplugError):
    """Options that contradict each other or name nothing."""


class PlugInError(UsageError):
    """A plug-in fails, or breaks its interface."""


class ClusterError(UsageError):
    """A cluster that has gone or is unfit, and so ends a whole batch."""


def listing(names: Sequence[str], most: int = 6) -> str:
    """Join names for a message, cut short where there are many."""
    first = ", ".join(names[:most])
    return first if len(names) <= most else f"{first} and {len(names) - most} more"


def one(noun: str) -> str:
    """A noun with its article."""
    return f"a{'n' * noun.lower().startswith(VOWELS)} {noun}"


def counted(number: int, noun: str) -> str:
    """A number of things in words: 1 view, 30,500 Gaussians."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def not_one_of(name: object, names: Iterable[str], otherwise: str = "") -> str:
    """Message for a value that is none of these: ends with the one that is like it, or `otherwise`."""
    known = list(names)
    return f"'{name}' is not one of {', '.join(known)}" + (did_you_mean(str(name), known) or otherwise)


def did_you_mean(name: str, names: Iterable[str]) -> str:
    """The end of a message about an unknown name: the one like it, if any."""
    matches = difflib.get_close_matches(name, list(names), 1)
    return f"; did you mean {matches[0]}?" if matches else ""


def printable(text: str) -> str:
    """The text with control characters, which command a terminal, in escaped form."""
    if text.isprintable():  # at once, as long texts need
        return text
    return "".join(c if c.isprintable() or category(c) == SPACE else repr(c)[1:-1] for c in text)


def reason(error: Exception) -> str:
    """The reason of a failure of a library or the system, as part of a sentence: an OSError's without number and path.

    Its first word is in lower case; names of files and symbols inside keep their case.
    """
    words = (error.strerror if isinstance(error, OSError) else None) or str(error)
    return words[:1].lower() + words[1:] if words[1:2].islower() else words


def failure(error: BaseException, package: str) -> str:
    """An error in words, with the last line of a package that it passed."""
    words = str(error) if isinstance(error, AaplugError) else " ".join(f"{type(error).__name__}: {error}".split())
    place = place_in(error, package)
    if place < 0:
        return words.rstrip(": ")
    frame, line = [*walk_tb(error.__traceback__)][place]
    return f"{words.rstrip(': ')}, in line {line} of {Path(frame.f_code.co_filename).name}"


def place_in(error: BaseException, package: str) -> int:
    """Place of the innermost frame of an error that runs a package's code; -1 if none does."""
    frames = enumerate(walk_tb(error.__traceback__))
    return max((place for place, (frame, _) in frames if top_package(frame) == package), default=-1)


def top_package(frame: FrameType) -> str:
    """The top package whose code a frame runs."""
    return frame.f_globals.get("__name__", "").partition(".")[0]


def of_system(error: BaseException | None) -> OSError | None:
    """The system's error, also behind or in the words of a library's own about a full disk."""
    if isinstance(error, RuntimeError):
        if said := next((number for number in FULL if os.strerror(number) in str(error)), None):
            return OSError(said, os.strerror(said))
        error = error.__context__
    return error if isinstance(error, OSError) else None


def is_lack_of_memory(error: BaseException) -> bool:
    """True if an error is Python's or torch's for lack of memory, or of threads."""
    words = str(error) if isinstance(error, RuntimeError) else ""
    return isinstance(error, MemoryError) or any(each in words for each in (*MEMORY_WORDS, NO_THREAD))


@contextmanager
def within_memory(what: str) -> Iterator[None]:
    """Turn an error for lack of memory or threads inside the block, Python's or torch's, into one of ours.

    Raises:
        UsageError: `what` needs more memory, or more threads, than the system gave.
    """
    try:
        yield
    except (MemoryError, RuntimeError) as error:
        if not is_lack_of_memory(error):
            raise
        problem = "out of memory; a smaller `scale`, fewer `threads` or fewer Gaussians need less"
        if NO_THREAD in str(error):
            what, problem = "threads", "the system starts no more; `ulimit -u` or the container limits their number"
        raise UsageError(what, problem) from error
