"""The program: words to verbs, errors to exit codes.

Exit codes: 0 all done, 1 some of the work failed, 2 the request cannot be carried out, 130 interrupted.
"""

import os
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version

import tyro

from aaplug.core.errors import AaplugError

from . import console
from .bench import Bench, bench
from .convert import Convert, convert
from .demo import Demo, demo
from .evaluate import Evaluate, evaluate
from .finetune import Finetune, finetune
from .info import Info, info
from .options import CONFIG
from .render import Render, render
from .video import Video, video
from .warmup import Warmup, warmup

FAILED, REFUSED, INTERRUPTED = 1, 2, 130
VERBS = {
    Info: info,
    Convert: convert,
    Render: render,
    Evaluate: evaluate,
    Video: video,
    Finetune: finetune,
    Demo: demo,
    Warmup: warmup,
    Bench: bench,
}
SEVERAL = {  # options that take several values, by verb
    "evaluate": ("--recipe", "--scale"),
    "finetune": ("--scale", "--move"),
    "bench": ("--gaussians", "--resolution"),
}


def main(words: Sequence[str] | None = None) -> None:
    """Run the program and exit."""
    words = list(sys.argv[1:] if words is None else words)
    if words == ["--version"]:
        print(f"aaplug {version('aaplug')}")
        sys.exit(0)
    console.set_up()
    try:
        sys.exit(run(words))
    except AaplugError as error:
        console.log.print(f"[red]error:[/] {console.escape(str(error))}")
        sys.exit(REFUSED)
    except MemoryError:
        console.log.print(
            "[red]error:[/] out of memory; a smaller --scale or fewer Gaussians need less"
        )
        sys.exit(REFUSED)
    except KeyboardInterrupt:
        console.say("interrupted")
        sys.exit(INTERRUPTED)
    except (
        BrokenPipeError
    ):  # whoever read our output has seen enough; nothing may be flushed to them at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(FAILED)


def run(words: Sequence[str]) -> int:
    """Run one verb with its options; its result is the exit code."""
    description = "Test-time anti-aliasing for pretrained 3D Gaussian Splatting scenes."
    options = tyro.extras.subcommand_cli_from_dict(
        {noun.__name__.lower(): noun for noun in VERBS},
        prog="aaplug",
        description=description,
        args=_joined(_parted(words)),
        config=CONFIG,
    )
    return VERBS[type(options)](options)


def _parted(words: Sequence[str]) -> list[str]:
    """`--scale 1,0.25` as the parser wants it, `--scale 1 0.25`; `--views`, which may be names, has commas too."""
    several, option = SEVERAL.get(words[0] if words else "", ()), ""
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
    """`--resolution -1x720` as one word, for the parser would take the value for a flag."""
    joined: list[str] = []
    for word in words:
        if joined and joined[-1] == "--resolution" and re.fullmatch(r"-?\d+x-?\d+", word):
            joined[-1] += "=" + word
        else:
            joined.append(word)
    return joined
