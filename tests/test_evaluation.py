"""Evaluation: what is compared with what, and what the report holds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug.cameras import BLACK
from aaplug.errors import UsageError
from aaplug.evaluation import NO_PHOTOGRAPH, Task, evaluate
from aaplug.io.images import downsample, quantise, read_image, write_png
from aaplug.metrics import psnr
from aaplug.pipeline import learn, render
from aaplug.recipes import RECIPES
from aaplug.report import CEILING, mean, per_view, results, scale_name, tables
from tests.conftest import make_camera, make_scene


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A scene, its training and two views whose photographs are slightly brightened renders."""
    folder: Path = tmp_path_factory.mktemp("photos")
    scene = make_scene(150)
    views = [make_camera((0.0, -4.0, 0.0), name="a"), make_camera((2.0, -4.0, 1.0), name="b")]
    training = learn(scene, views)
    for i, view in enumerate(views):
        image = render(scene, view, RECIPES["classic"], training).rgb
        write_png(folder / f"{view.name}.png", image * 0.9 + 0.05)
        views[i] = replace(view, photo=folder / f"{view.name}.png")
    return scene, training, views


def task(views, **changes) -> Task:
    recipes = [RECIPES["classic"], RECIPES["matched"]]
    defaults = {"background": BLACK, "truth": "photographs", "scales": (1.0, 0.5, 2.0)}
    return Task(recipes=recipes, views=views, **(defaults | changes))


def test_figures_are_those_of_the_images_compared_by_hand(world):
    scene, training, views = world
    report = evaluate(scene, training, task(views))
    for view in views:
        photo = quantise(read_image(view.photo, None))
        for scale, truth in ((1.0, photo), (0.5, downsample(photo, 2))):
            image = render(scene, view.scaled(scale), RECIPES["classic"], training).rgb
            found = next(m for m in report.select("classic", scale) if m.view == view.name)
            assert found.values["PSNR"] == pytest.approx(psnr(quantise(image), truth), abs=1e-9)


def test_the_ceiling_is_always_among_the_rows(world):
    scene, training, views = world
    report = evaluate(scene, training, task(views))
    assert report.recipes == (CEILING, "classic", "matched")
    full = render(scene, views[0], RECIPES["classic"], training).rgb.clamp(0, 1)
    expected = psnr(
        quantise(downsample(full, 2)), downsample(quantise(read_image(views[0].photo, None)), 2)
    )
    assert report.select(CEILING, 0.5)[0].values["PSNR"] == pytest.approx(expected, abs=1e-9)


def test_above_the_photographs_size_metrics_are_undefined_and_say_why(world):
    scene, training, views = world
    report = evaluate(scene, training, task(views))
    assert mean(report.select("matched", 2.0), "PSNR") is None
    assert results(report)["matched@2"] == {"PSNR": None, "SSIM": None}
    assert results(report)["_aaplug"]["notes"] == [NO_PHOTOGRAPH]


def test_self_truth_needs_no_photographs_and_makes_the_ceiling_perfect(world):
    scene, training, views = world
    bare = [replace(view, photo=None) for view in views]
    report = evaluate(scene, training, task(bare, truth="self"))
    assert mean(report.select(CEILING, 0.5), "PSNR") is None  # equal images
    assert mean(report.select(CEILING, 0.5), "SSIM") == pytest.approx(1.0)
    assert (
        mean(report.select("matched", 2.0), "PSNR") is None
    )  # its own truth above the training size
    assert mean(report.select("classic", 2.0), "PSNR") < 40
    assert mean(report.select("matched", 0.5), "PSNR") > mean(report.select("classic", 0.5), "PSNR")


def test_photographs_are_demanded_where_they_are_the_truth(world):
    scene, training, views = world
    with pytest.raises(UsageError, match="a: has no photograph"):
        evaluate(scene, training, task([replace(views[0], photo=None)]))


@pytest.mark.parametrize("changes", [{"scales": ()}, {"scales": (0.0,)}, {"scales": (1.0, 1.0)}])
def test_empty_or_doubled_work_is_refused(world, changes):
    scene, training, views = world
    with pytest.raises(UsageError):
        evaluate(scene, training, task(views, **changes))


def test_per_view_has_every_view_and_results_their_mean(world):
    scene, training, views = world
    report = evaluate(scene, training, task(views, scales=(0.5,)))
    values = per_view(report)["matched@0.5"]["PSNR"]
    assert list(values) == ["a", "b"]
    assert results(report)["matched@0.5"]["PSNR"] == pytest.approx(sum(values.values()) / 2)


def test_tables_show_every_recipe_and_scale(world):
    scene, training, views = world
    report = evaluate(scene, training, task(views))
    for table in tables(report):
        assert table.row_count == 3
        assert [column.header for column in table.columns] == ["recipe", "1", "1/2", "2×"]


def test_progress_counts_views(world):
    scene, training, views = world
    told = []
    evaluate(
        scene, training, task(views, scales=(0.5,)), progress=lambda *counts: told.append(counts)
    )
    assert told == [(0, 2), (1, 2), (2, 2)]


@pytest.mark.parametrize(
    ("scale", "name"), [(1.0, "1"), (0.25, "1/4"), (2.0, "2×"), (0.3, "0.3"), (1 / 3, "1/3")]
)
def test_scales_are_written_as_people_do(scale, name):
    assert scale_name(scale) == name


def test_evaluation_is_deterministic(world):
    scene, training, views = world
    reports = [evaluate(scene, training, task(views, scales=(0.5,))) for _ in range(2)]
    values = [[m.values for m in report.measurements] for report in reports]
    assert values[0] == values[1]
    assert all(torch.tensor(m.seconds) > 0 for m in reports[0].measurements)
