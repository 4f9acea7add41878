"""Promises kept on the bundled sample, a real pretrained scene."""

from aaplug.core.colours import WHITE
from aaplug.evaluation.engine import Task, evaluate, renderers_of
from aaplug.evaluation.metrics import PSNR
from aaplug.evaluation.results import CEILING, mean
from aaplug.evaluation.truth import Truth
from aaplug.methods import RECIPES
from aaplug.rendering.renderer import own_look
from tests.conftest import SAMPLE


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
