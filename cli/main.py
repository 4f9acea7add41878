"""The program: words to verbs, errors to exit codes.

Exit codes: 0 all done, 1 some of the work failed, 2 the request cannot be carried out, 130 interrupted.
"""

import errno
import gc
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib import import_module
from importlib.metadata import version
from typing import Any, get_args, get_origin

from aaplug.core.allocator import keep_freed_memory
from aaplug.core.errors import AaplugError, UsageError, printable, reason

FAILED, REFUSED, INTERRUPTED = 1, 2, 130
GARBAGE = 100_000  # new objects between searches for cycles; Python's 700 take a tenth of the time to start
DESCRIPTION = """Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.

  aaplug render scene.ply --cameras path/to/colmap --scale 0.25 -o images
  aaplug convert scene.ply --cameras path/to/colmap -o converted.ply
  aaplug VERB --help"""
UNWRITABLE = (errno.EPIPE, errno.ENOSPC, errno.EFBIG, errno.EDQUOT, errno.EIO)  # what writing our output meets
FILE = re.compile(r".*/.*|.*\.[A-Za-z]\w*", re.DOTALL)  # a word that names a file, unlike names and numbers
OPTION = re.compile(r"-(?![\d.])")  # how a word that is no negative number begins
VERBS = (
    "info",
    "convert",
    "lod",
    "render",
    "evaluate",
    "gather",
    "video",
    "compare",
    "finetune",
    "demo",
    "view",
    "warmup",
    "bench",
)


def main(words: Sequence[str] | None = None) -> None:
    """Run the program and exit."""
    try:
        code = _guarded(list(sys.argv[1:] if words is None else words))
        sys.stdout.flush()
        sys.exit(code)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except OSError as error:
        of_output = error.filename is None and error.errno in UNWRITABLE
        if of_output:  # its reader has gone, or the disk is full; flush nothing at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            sys.exit(FAILED)
        where = error.filename or ("output" if of_output else f"unexpected {type(error).__name__}")
        print(f"error: {printable(f'{where}: {reason(error)}')}", file=sys.stderr)
        sys.exit(REFUSED)


def program() -> None:
    """Run the program and end its process at once: what Python does at exit takes torch half a second."""
    keep_freed_memory()
    gc.set_threshold(GARBAGE)
    try:
        main()
    except SystemExit as end:
        with suppress(OSError):  # its reader has gone
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(end.code if isinstance(end.code, int) else FAILED if end.code else 0)


def _guarded(words: Sequence[str]) -> int:
    """Run one verb; mistakes of the user become a line on stderr and an exit code."""
    if words == ["--version"]:
        print(f"aaplug {version('aaplug')}")
        return 0
    from . import console

    console.set_up()
    try:
        return run(words)
    except AaplugError as error:
        console.refuse(_worded(error, words))
    except MemoryError:
        console.refuse("out of memory; a smaller --scale or fewer Gaussians need less")
    except RecursionError:
        console.refuse("an input is nested too deeply")
    return REFUSED


def run(words: Sequence[str]) -> int:
    """Run one verb with its options; its result is the exit code."""
    import tyro

    from .options import CONFIG, one_line

    words = _parted(words)
    if words and words[0] in VERBS:  # loading one verb is faster than loading all
        program = f"aaplug {words[0]}"
        with one_line(program):
            verb = tyro.cli(_verb(words[0]), prog=program, args=words[1:], config=CONFIG)
        return verb()
    with one_line("aaplug"):
        verb = tyro.extras.subcommand_cli_from_dict(
            {verb: _verb(verb) for verb in VERBS}, prog="aaplug", description=DESCRIPTION, args=words, config=CONFIG
        )
    return verb()


def _verb(name: str) -> type[Any]:
    """A verb's options; an instance is called to do the work."""
    return getattr(import_module(f".{name}", __package__), name.capitalize())


def _option_types(words: Sequence[str]) -> dict[str, Any]:
    """Types of the options, by name, of the verb that the first word names."""
    from .options import option_types

    return option_types(_verb(words[0])) if words and words[0] in VERBS else {}


def _worded(error: AaplugError, words: Sequence[str]) -> str:
    """The library's error, with parameters of the verb as its options."""
    from .options import worded

    known = _option_types(words)
    where = worded(f"`{error.where}`", known).strip("`") if isinstance(error, UsageError) else error.where
    return f"{where}: {worded(error.problem, known)}"


def _parted(words: Sequence[str]) -> list[str]:
    """The words as the parser wants them.

    `--scale 1,0.25` becomes `--scale 1 0.25`; `--views`, whose names hold commas, stays.  A file after such values goes
    to the front, where the parser does not take it for one of them.  `--resolution -1x720` becomes one word, because
    the parser would take the value for an option.
    """
    types = _option_types(words).items()
    several = {"--" + n.replace("_", "-") for n, t in types if Sequence in list(map(get_origin, (t, *get_args(t))))}
    option = ""
    parted: list[str] = []
    files: list[str] = []
    for word in words:
        if parted and parted[-1] == "--resolution" and re.fullmatch(r"-?\d+x-?\d+", word):
            parted[-1] += "=" + word
            continue
        flag, _, value = word.partition("=")
        option = flag if OPTION.match(word) else option
        if option not in several:
            parted.append(word)
        elif flag != option and FILE.fullmatch(word):
            files.append(word)
        elif flag == option:
            parted += [option, *filter(None, value.split(","))]
        else:
            parted += filter(None, word.split(","))
    return [*parted[:1], *files, *parted[1:]]
