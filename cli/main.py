"""The program: words to verbs, errors to exit codes.

Exit codes: 0 all done, 1 some of the work failed, 2 the request cannot be carried out, 130 interrupted.
"""

import os
import re
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.metadata import version
from typing import Any, get_args, get_origin

from aaplug.core.errors import AaplugError, UsageError

FAILED, REFUSED, INTERRUPTED = 1, 2, 130
VERBS = ("info", "convert", "render", "evaluate", "video", "finetune", "demo", "warmup", "bench")


def main(words: Sequence[str] | None = None) -> None:
    """Run the program and exit."""
    words = list(sys.argv[1:] if words is None else words)
    if words == ["--version"]:
        print(f"aaplug {version('aaplug')}")
        sys.exit(0)
    from . import console

    console.set_up()
    try:
        sys.exit(run(words))
    except AaplugError as error:
        console.log.print(f"[red]error:[/] {console.escape(_worded(error, words))}")
        sys.exit(REFUSED)
    except MemoryError:
        console.log.print("[red]error:[/] out of memory; a smaller --scale or fewer Gaussians need less")
        sys.exit(REFUSED)
    except KeyboardInterrupt:
        console.say("interrupted")
        sys.exit(INTERRUPTED)
    except BrokenPipeError:  # the reader of our output has gone; flush nothing to it at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)


def run(words: Sequence[str]) -> int:
    """Run one verb with its options; its result is the exit code."""
    import tyro

    from .options import CONFIG

    words = _joined(_parted(words))
    if words and words[0] in VERBS:  # loading one verb is faster than loading all
        noun, verb = _verb(words[0])
        return verb(tyro.cli(noun, prog=f"aaplug {words[0]}", args=words[1:], config=CONFIG))
    options = tyro.extras.subcommand_cli_from_dict(
        {verb: _verb(verb)[0] for verb in VERBS},
        prog="aaplug",
        description="Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.",
        args=words,
        config=CONFIG,
    )
    return _verb(type(options).__name__.lower())[1](options)


def _verb(name: str) -> tuple[type, Callable[[Any], int]]:
    """A verb's options and its function."""
    module = import_module(f".{name}", __package__)
    return getattr(module, name.capitalize()), getattr(module, name)


def _worded(error: AaplugError, words: Sequence[str]) -> str:
    """The library's error, with parameters of the verb as its options."""
    from .options import option_types, worded

    known = option_types(_verb(words[0])[0]) if words and words[0] in VERBS else {}
    where = error.where
    if isinstance(error, UsageError):
        where = worded(f"`{where}`", known).strip("`")
    return f"{where}: {worded(error.problem, known)}"


def _several(verb: str) -> list[str]:
    """Options of a verb that take any number of names or numbers."""
    from .options import option_types

    several = {
        name
        for name, kind in option_types(_verb(verb)[0]).items()
        for one in (kind, *get_args(kind))
        if get_origin(one) is Sequence
    }
    return ["--" + name.replace("_", "-") for name in several]


def _parted(words: Sequence[str]) -> list[str]:
    """`--scale 1,0.25` as the parser wants it, `--scale 1 0.25`; `--views`, whose names hold commas, stays."""
    several = _several(words[0]) if words and words[0] in VERBS else []
    option = ""
    parted: list[str] = []
    for word in words:
        flag, _, value = word.partition("=")
        option = flag if word.startswith("-") else option
        if option not in several:
            parted.append(word)
        elif flag == option:
            parted += [option, *filter(None, value.split(","))]
        else:
            parted += filter(None, word.split(","))
    return parted


def _joined(words: Sequence[str]) -> list[str]:
    """`--resolution -1x720` as one word, because the parser would take the value for an option."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] == "--resolution" and re.fullmatch(r"-?\d+x-?\d+", word):
            joined[-1] += "=" + word
        else:
            joined.append(word)
    return joined
