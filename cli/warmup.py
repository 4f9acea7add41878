"""aaplug warmup: compile the kernels once for this machine."""

from dataclasses import dataclass
from typing import Annotated

import aaplug
from aaplug.options.base import UNSET, OneOf, Options, choices
from aaplug.options.shared import RECIPE_NAMES

from .console import TERMINAL, print_json, say


@dataclass(frozen=True)
class Warmup(Options):
    """Compile the fast rasterizer once for this machine (two to three minutes)."""

    recipe: Annotated[tuple[str, ...], choices([*RECIPE_NAMES, "..."]), OneOf(kind="recipe"), UNSET] = ()
    """Compile what these recipes need, too; by default what auto, matched, classic and mip need."""
    json: bool = False
    """Print where the kernels are as one JSON object on stdout."""

    def __call__(self) -> int:
        """Compile what is missing and say where it is."""
        folder, names = aaplug.warmup(self.recipe, monitor=TERMINAL)
        say(f"{len(names)} kernels in {folder}")
        if self.json:
            print_json({"folder": str(folder), "kernels": names})
        return 0
