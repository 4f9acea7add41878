"""Views unlike those of training: python -m tests.bench.away [SCENE ...], of the names in SCENES.

A few test views at the training size, moved nearer and farther and with wider and narrower fields of view.  The truth
is the scene itself with enough samples per pixel to reach training's rate: each sample is then what training rendered.
From nearer there is no such truth.  There, a checkpoint trained at a smaller size is compared with the one trained at
full size.
"""

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch

from aaplug.core.camera_paths import moved, zoomed
from aaplug.core.cameras import BLACK, WHITE, Camera
from aaplug.core.choices import RateReference
from aaplug.core.imaging import quantised
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.metrics import psnr
from aaplug.evaluation.protocols import median_depth
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import find_recipe
from aaplug.rasterizers import find_rasterizer
from aaplug.rendering.renderer import Renderer
from tests.conftest import SHARED_DATA

VIEWS = 4


@dataclass(frozen=True)
class Scene:
    """A checkpoint and one trained at a finer scale.  scale: of training's images against the files'."""

    file: str
    finer: str | None = None
    scale: float = 1.0
    cull_margin: float = math.inf
    background: tuple[float, float, float] = WHITE


SCENES = {
    "chair": Scene("chair/chair.ply"),
    "chair_eighth": Scene("chair/chair_eighth.ply", "chair/chair.ply", 1 / 8),
    "snowmiku": Scene("snowmiku/snowmiku.ply", cull_margin=0.3, background=BLACK),
    "snowmiku_quarter": Scene("snowmiku/snowmiku_quarter.ply", "snowmiku/snowmiku.ply", 1 / 4, 0.3, BLACK),
}
# how finely a view samples against the view that it is made of
DISTANCES = {"2 times nearer": 2.0, "same distance": 1.0, "2 times farther": 0.5, "4 times farther": 0.25}
FIELDS = {"half the field of view": 2.0, "twice the field of view": 0.5}
MATCHED = find_recipe("matched", rate_reference="interval")
RATES: dict[str, RateReference] = {
    "A, global": "global",
    "B, sharpest": "sharpest",
    "C, interval": "interval",
    "pose": "pose",
}


def compared() -> dict[str, Recipe]:
    """Each rate reference with one sample per pixel, and the default recipe."""
    rates = {label: find_recipe("matched", rate_reference=rate) for label, rate in RATES.items()}
    return {"`classic`": find_recipe("classic"), **rates, "`auto`": find_recipe("auto")}


def main(names: Sequence[str] = tuple(SCENES)) -> None:
    on_each(names or SCENES, measure)


def on_each(names: Iterable[str], measured: Callable[[str, Scene, Rasterizer], None]) -> None:
    """Measure scenes with the fastest rasterizer that is built here."""
    torch.set_grad_enabled(False)
    rasterizer = find_rasterizer(say=print)
    for name in names:
        measured(name, SCENES[name], rasterizer)


def measure(name: str, scene: Scene, rasterizer: Rasterizer) -> None:
    """Print a table of PSNR in dB, mean of the views."""
    own, full = (read_scene(SHARED_DATA / (f or scene.file)) for f in (scene.file, scene.finer))
    folder = (SHARED_DATA / scene.file).parent
    small, large = (read_cameras(folder, train_scale=s) for s in (scene.scale, 1.0))
    training = TrainingViews.of(own, small, scene.cull_margin)
    finer = training if scene.finer is None else TrainingViews.of(full, large, scene.cull_margin)
    views = small.test[:: -(-len(small.test) // VIEWS)]
    chosen = {
        rule: Renderer(own, training, recipe, rasterizer, scene.background) for rule, recipe in compared().items()
    }
    looks_own = Renderer(own, training, MATCHED, rasterizer, scene.background)
    looks_finer = Renderer(full, finer, MATCHED, rasterizer, scene.background)
    print(f"\n{name}, {len(views)} views, PSNR in dB\n\n| camera | truth | " + " | ".join(chosen) + " |")
    print("|---" * (len(chosen) + 2) + "|")
    for label, factor in {**DISTANCES, **FIELDS}.items():
        truths = {"own look": looks_own} if factor < 1 else {}
        truths |= {} if scene.finer is None else {"finer": looks_finer}
        found: dict[str, dict[str, list[float]]] = {t: {rule: [] for rule in chosen} for t in truths}
        for view in views:
            camera = zoomed(view, factor) if label in FIELDS else moved(view, factor, median_depth(own.means, view))
            looks = {t: look_there(renderer, camera) for t, renderer in truths.items()}
            for rule, renderer in chosen.items():
                image = renderer(camera).rgb
                for t, look in looks.items():
                    found[t][rule].append(decibels(image, look))
        for t, rules in found.items():
            cells = (f"{sum(values) / len(values):.2f}" for values in rules.values())
            print(f"| {label} | {t} | " + " | ".join(cells) + " |", flush=True)


def look_there(renderer: Renderer, camera: Camera) -> torch.Tensor:
    """The image that training would have rendered there, if its pixels were as small as they were in the scene."""
    rate = renderer.relative_rate(replace(camera, trained_focal=None))
    recipe = replace(renderer.recipe, grid=max(1, math.ceil(1 / rate)))
    return quantised(replace(renderer, recipe=recipe)(camera).rgb)


def decibels(image: torch.Tensor, truth: torch.Tensor) -> float:
    """PSNR of an image as it is stored; infinite where it is the truth."""
    found = psnr(quantised(image), truth)
    return math.inf if found is None else found


if __name__ == "__main__":
    main(sys.argv[1:])
