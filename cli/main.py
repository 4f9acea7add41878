"""The program: words to verbs, errors to exit codes.

Exit codes: 0 all done, 1 some of the work failed, 2 the request cannot be carried out, 130 interrupted.
"""

import os
import re
import sys
from collections.abc import Sequence
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

    from .options import CONFIG, one_line

    words = _parted(words)
    if words and words[0] in VERBS:  # loading one verb is faster than loading all
        program = f"aaplug {words[0]}"
        with one_line(program):
            verb = tyro.cli(_verb(words[0]), prog=program, args=words[1:], config=CONFIG)
        return verb()
    with one_line("aaplug"):
        verb = tyro.extras.subcommand_cli_from_dict(
            {verb: _verb(verb) for verb in VERBS},
            prog="aaplug",
            description="Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes.",
            args=words,
            config=CONFIG,
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

    `--scale 1,0.25` becomes `--scale 1 0.25`; `--views`, whose names hold commas, stays.  `--resolution -1x720` becomes
    one word, because the parser would take the value for an option.
    """
    types = _option_types(words).items()
    several = {"--" + n.replace("_", "-") for n, t in types if Sequence in list(map(get_origin, (t, *get_args(t))))}
    option = ""
    parted: list[str] = []
    for word in words:
        if parted and parted[-1] == "--resolution" and re.fullmatch(r"-?\d+x-?\d+", word):
            parted[-1] += "=" + word
            continue
        flag, _, value = word.partition("=")
        option = flag if word.startswith("-") else option
        if option not in several:
            parted.append(word)
        elif flag == option:
            parted += [option, *filter(None, value.split(","))]
        else:
            parted += filter(None, word.split(","))
    return parted
