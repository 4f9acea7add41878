"""Views that training never had: python -m tests.bench.away [SCENE ...], of the names in SCENES.

Cameras nearer and farther than training's, and wider and narrower fields of view, of a few test views at the training
size.  The truth is the scene's own look with as many samples a pixel as reach training's rate: each sample is then what
training itself rendered.  Nearer there is no such truth; a checkpoint trained smaller is compared with the look of the
one trained at full size as well, which knows.
"""

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch

from aaplug.core.camera_paths import moved, zoomed
from aaplug.core.cameras import BLACK, WHITE, Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.metrics import psnr
from aaplug.evaluation.protocols import median_depth
from aaplug.io.cameras import read_cameras
from aaplug.io.images import quantised
from aaplug.io.scenes import read_scene
from aaplug.methods.filters import RateChoice
from aaplug.methods.recipes import Recipe, find_recipe
from aaplug.rasterizers.tiled.ahead_of_time import choose
from aaplug.rendering.renderer import learn, rate_of, render
from tests.conftest import SHARED_DATA

VIEWS = 4


@dataclass(frozen=True)
class Scene:
    """A checkpoint and the one that knows better.  scale: of training's images against the files'."""

    file: str
    finer: str | None = None
    scale: float = 1.0
    guard: float = math.inf
    background: tuple[float, float, float] = WHITE


SCENES = {
    "chair": Scene("chair/chair.ply"),
    "chair_eighth": Scene("chair/chair_eighth.ply", "chair/chair.ply", 1 / 8),
    "snowmiku": Scene("snowmiku/snowmiku.ply", guard=0.3, background=BLACK),
    "snowmiku_quarter": Scene(
        "snowmiku/snowmiku_quarter.ply", "snowmiku/snowmiku.ply", 1 / 4, 0.3, BLACK
    ),
}
# how finely a view samples against the view that it is made of
DISTANCES = {
    "2 times nearer": 2.0,
    "same distance": 1.0,
    "2 times farther": 0.5,
    "4 times farther": 0.25,
}
FIELDS = {"half the field of view": 2.0, "twice the field of view": 0.5}
RATES: dict[str, RateChoice] = {
    "A, global": "global",
    "B, sharpest": "sharpest",
    "C, interval": "interval",
    "pose": "pose",
}


def compared() -> dict[str, Recipe]:
    """Each rate choice with one sample a pixel, and what is the default."""
    rates = {label: find_recipe("matched", rate=rate) for label, rate in RATES.items()}
    return {"`classic`": find_recipe("classic"), **rates, "`auto`": find_recipe("auto")}


def main(names: Sequence[str] = tuple(SCENES)) -> None:
    on_each(names or SCENES, measure)


def on_each(names: Iterable[str], measured: Callable[[str, Scene, Rasterizer], None]) -> None:
    """Measure scenes with the fastest rasterizer that is built here."""
    torch.set_grad_enabled(False)
    rasterizer = choose("auto", 1, print)
    for name in names:
        measured(name, SCENES[name], rasterizer)


def measure(name: str, scene: Scene, rasterizer: Rasterizer) -> None:
    """Print a table of PSNR in dB, mean of the views."""
    own, full = (read_scene(SHARED_DATA / (f or scene.file)) for f in (scene.file, scene.finer))
    folder = (SHARED_DATA / scene.file).parent
    small, large = (read_cameras(folder, train_scale=s) for s in (scene.scale, 1.0))
    training = learn(own, small.train, scene.guard)
    trained = training if scene.finer is None else learn(full, large.train, scene.guard)
    views = small.test[:: -(-len(small.test) // VIEWS)]
    chosen = compared()
    print(
        f"\n{name}, {len(views)} views, PSNR in dB\n\n| camera | truth | "
        + " | ".join(chosen)
        + " |"
    )
    print("|---" * (len(chosen) + 2) + "|")
    for label, factor in {**DISTANCES, **FIELDS}.items():
        truths = {"own look": (own, training)} if factor < 1 else {}
        truths |= {} if scene.finer is None else {"finer": (full, trained)}
        found: dict[str, dict[str, list[float]]] = {
            t: {rule: [] for rule in chosen} for t in truths
        }
        for view in views:
            camera = (
                zoomed(view, factor)
                if label in FIELDS
                else moved(view, factor, median_depth(own.means, view))
            )
            looks = {
                t: look_there(*known, camera, rasterizer, scene) for t, known in truths.items()
            }
            for rule, recipe in chosen.items():
                image = render(own, camera, recipe, training, rasterizer, scene.background).rgb
                for t, look in looks.items():
                    found[t][rule].append(decibels(image, look))
        for t, rules in found.items():
            cells = (f"{sum(values) / len(values):.2f}" for values in rules.values())
            print(f"| {label} | {t} | " + " | ".join(cells) + " |", flush=True)


def look_there(
    scene: Gaussians, training: TrainingViews, camera: Camera, rasterizer: Rasterizer, how: Scene
) -> torch.Tensor:
    """The look that training would have rendered there, if its pixels were as small as they were in the scene."""
    rate = rate_of(scene, replace(camera, trained_focal=None), training)
    recipe = replace(find_recipe("matched", rate="interval"), grid=max(1, math.ceil(1 / rate)))
    return quantised(render(scene, camera, recipe, training, rasterizer, how.background).rgb)


def decibels(image: torch.Tensor, truth: torch.Tensor) -> float:
    """PSNR of an image as it is stored; infinite where it is the truth."""
    found = psnr(quantised(image), truth)
    return math.inf if found is None else found


if __name__ == "__main__":
    main(sys.argv[1:])
