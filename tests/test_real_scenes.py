"""Promises kept on real pretrained scenes, which may lie beside the repository, and on the bundled sample."""

from dataclasses import replace

import torch

from aaplug.core.cameras import Camera
from aaplug.core.colours import WHITE
from aaplug.core.ellipses import cull
from aaplug.core.projection import project
from aaplug.core.shading import shade
from aaplug.evaluation.engine import Task, evaluate, renderers_of
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import CEILING, mean
from aaplug.evaluation.truth import Truth
from aaplug.methods import RECIPES
from aaplug.rasterizers import RASTERIZERS
from aaplug.rendering.renderer import own_look
from tests.conftest import SAMPLE

TOLERANCE = 1e-5  # of an image's range, away from cut-offs
FLIPS = 1e-4  # share of pixels near a cut-off that may differ by more


def test_tiled_equals_the_reference_on_the_sample(sample_scene, sample_cameras, sample_training):
    """A window at the training size and the whole view at 1/40, so that every size of splat is there."""
    view, sample_scene = sample_cameras.test[1], sample_scene[torch.arange(0, len(sample_scene), 4)]
    differences = []
    for part in [window(view, 380, 330, 20), view.scaled(1 / 40)]:
        splats = RECIPES["classic"].screen(project(sample_scene, part), part, sample_training)
        splats = shade(cull(splats, part.hw), sample_scene, part)
        pixel = RECIPES["classic"].pixel
        fast, exact = (RASTERIZERS[name](splats, part.hw, WHITE, pixel) for name in ("eager", "reference"))
        assert exact.alpha.min() < 0.5 < exact.alpha.max()  # an edge is in sight
        differences.append((fast.rgb - exact.rgb).abs().amax(dim=2).flatten())
    difference = torch.cat(differences)
    assert difference.median() < TOLERANCE / 10
    assert (difference > TOLERANCE).double().mean() <= FLIPS


def window(view: Camera, left: int, top: int, side: int) -> Camera:
    """A square part of a view, at full resolution."""
    return replace(view, width=side, height=side, cx=view.cx - left, cy=view.cy - top)


def test_recipes_rank_as_measured_on_the_sample(sample_scene, sample_cameras, sample_training):
    """The order that the project stands for, at 1/8 on one photograph; figures are in the README."""
    recipes = [RECIPES[name] for name in ("classic", "mip", "matched", "auto")]
    look = own_look(sample_scene, sample_training, "eager", WHITE)
    renderers = renderers_of(sample_scene, sample_training, recipes, "eager", WHITE)
    task = Task(renderers, (0.125,), sample_cameras.test[1:2], Truth(look, "photographs"), [PSNR])
    report = evaluate(task)
    dB = {name: mean(report.select(name, 0.125), "PSNR") for name in report.recipes}
    assert dB["classic"] + 7 < dB["mip"] < dB["matched"] < dB["auto"] - 6, dB
    assert dB["classic"] + 17 < dB["auto"]
    assert dB[CEILING] - dB["auto"] < 0.7


def test_the_sample_is_small_and_tells_its_origin():
    files = [path for path in SAMPLE.rglob("*") if path.suffix in {".ply", ".json", ".png", ".md"}]
    assert sum(path.stat().st_size for path in files) < 6e6
    assert "CC0" in (SAMPLE / "ORIGIN.md").read_text()
