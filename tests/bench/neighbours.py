"""The weight of a sample's neighbours in `auto`: python -m tests.bench.neighbours [SCENE ...], of the names in `away`.

Prints PSNR in dB of one and of four samples per pixel, by weight, against photographs and the scene's own look.
"""

import sys
from dataclasses import replace

from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.results import scale_name
from aaplug.evaluation.truth import Truth, ViewTruth, own_look
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.methods.recipes import find_recipe
from tests.bench.away import VIEWS, Scene, decibels, on_each
from tests.conftest import SHARED_DATA

FROM = 2  # the first test view; other tables have those from the first
WEIGHTS = (0.0, 0.02, 0.03, 0.04, 0.06)
CASES = (("fast", 1 / 2), ("fast", 1 / 4), ("balanced", 1 / 4))


def measure(name: str, how: Scene, rasterizer: Rasterizer) -> None:
    """Print a scene's table."""
    cameras = read_cameras((SHARED_DATA / how.file).parent, train_scale=how.scale)
    scene = read_scene(SHARED_DATA / how.file)
    look = own_look(scene, TrainingViews.of(scene, cameras, how.cull_margin), rasterizer, how.background)
    views = cameras.test[FROM :: -(-len(cameras.test) // VIEWS)]
    print(f"\n{name}, views {', '.join(view.name for view in views)}\n")
    print(f"| | {' | '.join(f'{weight:g}' for weight in WEIGHTS)} |\n|{'---|' * (len(WEIGHTS) + 1)}")
    for quality, scale in CASES:
        recipe = find_recipe("auto", quality=quality)
        drawn = [replace(look, recipe=replace(recipe, neighbours=weight)) for weight in WEIGHTS]
        images = [[renderer(view.scaled(scale)).rgb for renderer in drawn] for view in views]
        for label, truth in (("photographs", Truth(look, "photographs")), ("own look", Truth(look))):
            wanted = [ViewTruth(truth, view).compared(scale) for view in views]
            rows = [[decibels(i, w) for i in row] for row, w in zip(images, wanted, strict=True) if w is not None]
            cells = (f"{sum(column) / len(column):.2f}" for column in zip(*rows, strict=True))
            print(f"| `{quality}` at {scale_name(scale)}: {label} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    on_each(sys.argv[1:] or ("chair", "snowmiku"), measure)
