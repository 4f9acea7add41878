"""aaplug warmup: compile the kernels once for this machine."""

from dataclasses import dataclass

import aaplug

from .console import TERMINAL, print_json, say


@dataclass(frozen=True)
class Warmup:
    """Compile the fast rasterizer once for this machine (two to three minutes)."""

    json: bool = False
    """Print where the kernels are as one JSON object on stdout."""

    def __call__(self) -> int:
        """Compile what is missing and say where it is."""
        folder, names = aaplug.warmup(monitor=TERMINAL)
        say(f"{len(names)} kernels in {folder}")
        if self.json:
            print_json({"folder": str(folder), "kernels": names})
        return 0
