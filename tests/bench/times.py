"""Processor time of a view of the bundled chair by several recipes, in turn, both interpreted or both compiled."""

import time
from functools import partial
from importlib.resources import as_file, files

from aaplug import Renderer, read_cameras, read_scene
from aaplug.core.colours import WHITE
from tests.bench import heading, row, timed
from tests.bench.method_tables import keep

RECIPES: dict[str, tuple[str, ...]] = {"eager": ("classic", "ewa", "mip", "sa-gs", "matched", "analytic")}
RECIPES["compiled"] = RECIPES["eager"][:-1]  # the kernel of `analytic` is in the lab, and is interpreted
ROUNDS = {"eager": 3, "compiled": 15}


def main() -> None:
    """Print the table, and write tables/times.csv: the least of some rounds, in ms."""
    with as_file(files("aaplug.io.sample")) as sample:
        scene, cameras = read_scene(sample / "chair.ply").gaussians(), read_cameras(sample)
    view, lines = cameras.test[0], [("rasterizer", "recipe", "ms")]
    heading("times", *lines[0])
    for rasterizer, recipes in RECIPES.items():
        drawn = {name: Renderer.of(scene, cameras, name, background=WHITE, rasterizer=rasterizer) for name in recipes}
        works = {name: partial(renderer, view) for name, renderer in drawn.items()}
        least = timed(works, ROUNDS[rasterizer], min, time.process_time)
        lines += [(rasterizer, name, f"{1000 * seconds:.1f}") for name, seconds in least.items()]
    for line in lines[1:]:
        row(*line)
    keep("times", lines, "OMP_NUM_THREADS=1 python -m tests.bench times")
