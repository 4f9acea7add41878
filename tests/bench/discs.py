"""Discs by compiled and by eager kernels: milliseconds a frame, and the ratio.

The chair's Gaussians are drawn as discs across their thinnest axes.  Compiled kernels are those that
`aaplug warmup --recipe 2dgs 2dgs-matched aa-2dgs` builds, which this does first where they are missing.
"""

import time

import torch

from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.choice import find_rasterizer
from aaplug.verbs.warmup import warmup
from tests.bench import heading, row
from tests.bench.scenes import trained

RECIPES = ("2dgs", "2dgs-matched", "aa-2dgs")
SCALES = (1.0, 1 / 4)


@torch.no_grad()
def main(rounds: int = 3, threads: int = 1) -> None:
    """Print the table: of so many rounds, in which both take turns, the fastest frame of each."""
    torch.set_num_threads(threads)
    warmup(RECIPES)
    opened = trained("chair")
    [view] = opened.views(1)
    heading(f"one view of the chair, {threads} thread", "recipe", "size", "eager, ms", "compiled, ms", "times as fast")
    for recipe in RECIPES:
        kinds = [opened.renderer(recipe, rasterizer=r) for r in (RASTERIZERS["eager"], find_rasterizer("compiled"))]
        for scale in SCALES:
            seconds = []
            for renderer in rounds * kinds:
                started = time.perf_counter()
                renderer(view.scaled(scale))
                seconds.append(time.perf_counter() - started)
            eager, compiled = (1e3 * min(seconds[kind::2]) for kind in (0, 1))
            row(f"`{recipe}`", f"1/{1 / scale:g}", round(eager), round(compiled), eager / compiled)
