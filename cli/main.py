"""The program: words to verbs, errors to exit codes.

Exit codes: 0 all done, 1 some of the work failed, 2 the request cannot be carried out, 130 interrupted.
"""

import gc
import json
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from textwrap import fill

from aaplug.system.allocator import keep_freed_memory
from aaplug.system.errors import FULL, AaplugError, UsageError, did_you_mean, printable, reason
from aaplug.system.signals import end_as_by_interrupt

FAILED, REFUSED, INTERRUPTED = 1, 2, 130  # exit codes
GARBAGE = 100_000  # new objects between searches for cycles; Python's 700 take a tenth of the time to start
DESCRIPTION = """Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.

  aaplug render scene.ply --cameras path/to/colmap --scale 0.25 -o images
  aaplug convert scene.ply --cameras path/to/colmap -o converted.ply
  aaplug VERB --help"""
PLOTS_FOLDER = "MPLCONFIGDIR"  # of the environment; matplotlib sets it to a temporary folder if home is read-only


def main(words: Sequence[str] | None = None) -> None:
    """Run the program and exit; mistakes of the user become a line on stderr and an exit code."""
    words = list(sys.argv[1:] if words is None else words)
    try:
        if words == ["--version"]:
            with _printing():
                print(f"aaplug {version('aaplug')}")
            sys.exit()
        from . import console

        console.set_up()
        try:
            sys.exit(run(words))
        except AaplugError as error:
            console.refuse(str(error))
        except RecursionError:
            console.refuse("an input is nested too deeply")
        sys.exit(REFUSED)
    except KeyboardInterrupt:
        with suppress(OSError):  # its terminal has closed
            print("interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except OSError as error:
        _drop_output()  # where the disk is full, nothing can be flushed at exit
        if isinstance(error, BrokenPipeError):  # of the log
            sys.exit(FAILED)
        where = error.filename or ("output" if error.errno in FULL else f"unexpected {type(error).__name__}")
        print(f"error: {printable(f'{where}: {reason(error)}')}", file=sys.stderr)
        sys.exit(REFUSED)


def program() -> None:
    """Run the program and end its process at once: what Python does at exit takes torch half a second."""
    keep_freed_memory()
    end_as_by_interrupt()
    gc.set_threshold(GARBAGE)
    given = os.environ.get(PLOTS_FOLDER)
    try:
        main()
    except SystemExit as end:
        made = os.environ.get(PLOTS_FOLDER)
        if made and made != given:
            shutil.rmtree(made, ignore_errors=True)
        with suppress(OSError):  # its reader has gone
            print(end="", flush=True)  # unlike `flush`, also where the caller has closed stdout
            print(end="", file=sys.stderr, flush=True)
        os._exit(end.code if isinstance(end.code, int) else FAILED if end.code else 0)


@contextmanager
def _printing(code: int = 0) -> Iterator[None]:
    """Print on stdout; end with `code` where its reader has enough, as `head` has."""
    try:
        try:
            yield
        finally:
            print(end="", flush=True)
    except BrokenPipeError:
        _drop_output()
        sys.exit(code)


def _drop_output() -> None:
    """Write what stdout still holds nowhere."""
    with suppress(OSError), open(os.devnull, "w", encoding="utf-8") as nowhere:
        os.dup2(nowhere.fileno(), sys.stdout.fileno())


def run(words: Sequence[str]) -> int:
    """Run one verb with its options; returns the exit code."""
    from . import console
    from .verbs import VERBS

    if words and words[0] in VERBS:
        command = VERBS[words[0]]
        with command.errors("aaplug"):
            with _printing():  # --help
                given = command.parse(words[1:])
            try:
                os.getcwd()
            except OSError as error:  # it was removed, where torch ends the program with a line about its libraries
                raise UsageError("current folder", f"cannot be used: {reason(error)}; change to another") from error
            several = given.values.get("batch") is not None  # then each scene's are checked with its file
            answer = command.run(given if several else given.checked())
        code = FAILED if answer.failed else 0
        with _printing(code):
            if given.values.get("json"):
                print(json.dumps(answer.facts, indent=1, allow_nan=False))
            elif answer.shown:
                console.show(answer.shown)
        return code
    if words and words[0] in ("-h", "--help"):
        columns, longest = shutil.get_terminal_size().columns, max(map(len, VERBS))
        with _printing():
            print(f"usage: aaplug [-h] VERB ...\n\n{DESCRIPTION}\n")
            for name, command in VERBS.items():
                first = command.help.partition("\n\n")[0]
                print(fill(f"  {name:{longest}}  {first}", columns, subsequent_indent=" " * (longest + 4)))
        return 0
    if not words:
        problem = f"name a verb: {', '.join(VERBS)}"
    elif words[0].startswith("-"):
        problem = f"Unrecognized options: {words[0]}"
    else:
        problem = f"there is no verb '{words[0]}'{did_you_mean(words[0], VERBS)}"
    raise UsageError("aaplug", f"{problem}; see `aaplug --help`")
