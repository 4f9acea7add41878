"""Large scenes: what `balanced` draws of their levels."""

from dataclasses import replace

import pytest
import torch

import aaplug
from aaplug import CameraSet, Pyramid, TrainingViews, find_recipe
from aaplug.evaluation.engine import Task, evaluate, renderers_of
from aaplug.evaluation.results import mean
from aaplug.evaluation.truth import Truth
from aaplug.methods.recipe import LevelChoice, Recipe
from aaplug.rendering.renderer import Renderer, own_look
from tests.conftest import make_camera, make_scene

VIEWS = tuple(make_camera(eye, (64, 48)) for eye in ((0.0, -4.0, 0.0), (3.0, -2.0, 1.0)))
CAMERAS = CameraSet(VIEWS, VIEWS)


def in_one_chunk(*counts: int) -> Pyramid:
    """Levels of so many Gaussians, of different scenes."""
    scenes = [make_scene(count) for count in counts]
    return Pyramid.of(scenes, [torch.zeros(len(scene), dtype=torch.int64) for scene in scenes])


def limited_to(levels: Pyramid, **choice: float) -> Renderer:
    renderer = Renderer.of(levels, CAMERAS, rasterizer="eager")
    return replace(renderer, recipe=replace(renderer.recipe, levels=LevelChoice(**choice, finer=1.0)))


@pytest.mark.parametrize(
    ("budget", "share", "expected"),
    [
        *((0, 0.0, 0.5), (50, 0.0, 0.0), (49, 0.0, 0.5), (44, 0.0, 0.5)),
        *((0, 0.25, 0.0), (0, 0.24, 0.5), (50, 0.1, 0.0), (10, 0.25, 0.0)),
    ],
)
def test_balanced_draws_coarser_levels_where_they_are_many_and_a_large_share(budget, share, expected):
    """Of 200 Gaussians, level 1 has 50 and level 2 has 45; a view at 1/8 has 4 samples, at the rate of level 1."""
    limited, view = limited_to(in_one_chunk(200, 50, 45, 5), budget=budget, share=share), VIEWS[0].scaled(1 / 8)
    fine, samples = limited.sampled(view)
    assert samples == limited.samples(view) == 4
    assert limited.coarsening(fine, samples) == expected
    assert limited.cutter is not None
    assert limited.cutter.count(fine, expected) == (50 if expected == 0 else 45)
    assert len(limited.cutter(fine, expected)) > 0
    assert limited.draw(view).splats.sources.tolist() == limited.splats(fine, samples).sources.tolist()


@pytest.mark.parametrize(("quality", "expected"), [("fast", 0.5), ("balanced", 0.0)])
def test_levels_of_several_samples_stay_as_fine_as_the_quality_asks(quality, expected):
    levels = in_one_chunk(200_000, 150_000, 120_000)
    renderer = Renderer.of(levels, CAMERAS, quality=quality, rasterizer="eager")
    assert renderer.coarsening(VIEWS[0].scaled(1 / 2), 2) == expected


@pytest.mark.parametrize("scale", [1 / 4.17, 1 / 5, 1 / 9, 1 / 10, 1 / 10.5])
def test_where_no_level_is_light_enough_the_lightest_is_drawn_alone(scale):
    """And not two that fade."""
    limited = limited_to(in_one_chunk(200, 150, 120))
    fine, samples = limited.sampled(VIEWS[0].scaled(scale))
    assert limited.cutter is not None
    assert limited.cutter(fine, limited.coarsening(fine, samples)).shares is None


def test_evaluation_tells_apart_recipes_that_draw_different_levels():
    levels = in_one_chunk(200, 150, 20)
    training = TrainingViews.of(levels.finest, VIEWS)
    fine = find_recipe("auto")
    coarse = replace(fine, name="coarse", levels=LevelChoice())
    truth = Truth(own_look(levels.finest, training, "eager"))

    def figures(*recipes: Recipe) -> list[float | None]:
        renderers = renderers_of(own_look(levels, training, "eager"), recipes)
        report = evaluate(Task(renderers, (1 / 8,), VIEWS[:1], truth))
        return [mean(report.select(recipe.name, 1 / 8), "PSNR") for recipe in recipes]

    assert figures(fine, coarse) == [*figures(fine), *figures(coarse)]
    assert figures(fine) != figures(coarse)


def test_a_comparison_of_levels_is_written_and_is_of_all_of_them(tmp_path, monkeypatch):
    monkeypatch.setattr("aaplug.verbs.compare.write_page", lambda *given: [])
    levels, other = in_one_chunk(200, 50), in_one_chunk(200, 40)
    how = {"output": tmp_path / "out", "scale": (1 / 8,), "rasterizer": "eager", "metric": "psnr", "resume": True}
    aaplug.compare({"levels": levels, "finest": levels.finest}, CAMERAS, **how)
    with pytest.raises(aaplug.UsageError, match="scenes_sha256"):
        aaplug.compare({"levels": other, "finest": levels.finest}, CAMERAS, **how)
