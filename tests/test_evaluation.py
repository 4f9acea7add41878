"""Evaluation: what is compared with what, and what the report holds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug.core.cameras import CameraSet
from aaplug.core.errors import UsageError
from aaplug.core.imaging import box_average, quantised
from aaplug.core.registry import KINDS
from aaplug.core.training import TrainingViews
from aaplug.evaluation.engine import NO_PHOTOGRAPH, Candidate, Task, candidates_of, compare, evaluate
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.metric import Metric, TimedRenderer
from aaplug.evaluation.metrics import CONSISTENCY, ENERGY, FLICKER, METRICS, PSNR, SSIM, psnr
from aaplug.evaluation.protocols import PROTOCOLS
from aaplug.evaluation.results import CEILING, as_csv, mean, per_view, results, scale_name, tables
from aaplug.evaluation.truth import KEPT, Truth, back_projected, own_look
from aaplug.io.images import read_image, write_png
from aaplug.methods.recipes import RECIPES, find_recipe
from aaplug.rasterizers import RASTERIZERS
from aaplug.rendering.renderer import Renderer
from aaplug.verbs.compare import compare as compare_scenes
from tests.conftest import make_camera, make_scene


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The scene's own look, and two views whose photographs are slightly brightened renders."""
    folder: Path = tmp_path_factory.mktemp("photos")
    views = [make_camera((0.0, -4.0, 0.0), name="a"), make_camera((2.0, -4.0, 1.0), name="b")]
    scene = make_scene(150)
    look = own_look(scene, TrainingViews.of(scene, views), "eager")
    for i, view in enumerate(views):
        write_png(folder / f"{view.name}.png", drawn(look, view) * 0.9 + 0.05)
        views[i] = replace(view, photo=folder / f"{view.name}.png")
    return look, views


def drawn(look, view, recipe="classic"):
    return replace(look, recipe=RECIPES[recipe])(view).rgb


def task(look, views, source="photographs", protocol="default", recipes=("classic", "matched"), **changes):
    recipes = [find_recipe(recipe) if isinstance(recipe, str) else recipe for recipe in recipes]
    candidates = candidates_of(look.scene, look.training, recipes, look.rasterizer)
    truth = Truth(look, source, PROTOCOLS[protocol])
    return Task(**({"candidates": candidates, "scales": (1.0, 0.5, 2.0), "views": views, "truth": truth} | changes))


def test_figures_are_those_of_the_images_compared_by_hand(world):
    look, views = world
    report = evaluate(task(look, views))
    assert report.recipes == (CEILING, "classic", "matched")
    for view in views:
        photo = quantised(read_image(view.photo, None))
        ceiling = next(m for m in report.select(CEILING, 0.5) if m.view == view.name).values["PSNR"]
        resampled = quantised(box_average(drawn(look, view).clamp(0, 1), 2))
        assert ceiling == pytest.approx(psnr(resampled, box_average(photo, 2)), abs=1e-9)
        for scale, truth in ((1.0, photo), (0.5, box_average(photo, 2))):
            image = drawn(look, view.scaled(scale), "classic")
            found = next(m for m in report.select("classic", scale) if m.view == view.name)
            assert found.values["PSNR"] == pytest.approx(psnr(quantised(image), truth), abs=1e-9)


def test_self_truth_needs_no_photographs_and_makes_the_ceiling_perfect(world):
    look, views = world
    bare = [replace(view, photo=None) for view in views]
    report = evaluate(task(look, bare, "self"))
    assert mean(report.select(CEILING, 0.5), "PSNR") is None  # equal images
    assert mean(report.select(CEILING, 0.5), "SSIM") == pytest.approx(1.0)
    assert mean(report.select("matched", 2.0), "PSNR") is None  # its own truth above the training size
    assert mean(report.select("classic", 2.0), "PSNR") < 40
    assert mean(report.select("matched", 0.5), "PSNR") > mean(report.select("classic", 0.5), "PSNR")


def test_work_without_a_truth_empty_or_doubled_is_refused(world):
    look, views = world
    bare = [replace(views[0], photo=None)]
    for work, words in (
        (task(look, views, scales=()), "needs at least"),
        (task(look, views, scales=(0.0,)), "above 0"),
        (task(look, views, scales=(1.0, 1.0)), "named twice"),
        (task(look, bare), "a: has no photograph"),
        (task(look, views, protocol="fov"), "moves the camera"),
    ):
        with pytest.raises(UsageError, match=words):
            evaluate(work)


def test_reports_hold_every_view_recipe_and_scale(world):
    look, views = world
    report = evaluate(task(look, views))
    values = per_view(report)["matched@0.5"]["PSNR"]
    assert list(values) == ["a", "b"]
    assert results(report)["matched@0.5"]["PSNR"] == pytest.approx(sum(values.values()) / 2)
    for table in tables(report):
        assert table.row_count == 3
        assert [column.header for column in table.columns] == ["recipe", "1", "1/2", "2×"]
    lines = as_csv({'a "scene"': report}).splitlines()
    assert lines[0] == "scene,protocol,recipe,scale,view,PSNR,SSIM,samples,evaluations,seconds,note"
    assert len(lines) == 1 + len(report.measurements)
    assert lines[1].startswith('"a ""scene""",default,"training size, resampled",1,a,')
    assert mean(report.select("matched", 2.0), "PSNR") is None  # above the photographs' size
    assert results(report)["matched@2"] == {"PSNR": None, "SSIM": None}
    assert results(report)["_aaplug"]["notes"] == [NO_PHOTOGRAPH]


@pytest.mark.parametrize(("scale", "name"), [(1.0, "1"), (0.25, "1/4"), (2.0, "2×"), (0.3, "0.3"), (1 / 3, "1/3")])
def test_scales_are_written_as_people_do(scale, name):
    assert scale_name(scale) == name


def test_evaluations_are_counted_and_fewer_where_images_are_smaller(world):
    look, views = world
    report = evaluate(task(look, views))
    for recipe in ("classic", "matched"):
        small, full = (report.select(recipe, scale)[0].evaluations for scale in (0.5, 1.0))
        assert 0 < small < full
    slow = replace(look, rasterizer=RASTERIZERS["reference"])
    assert evaluate(task(slow, views[:1], scales=(0.5,))).measurements[0].evaluations is None


@pytest.mark.parametrize("name", [n for n, r in RECIPES.items() if r.selection is None])
def test_the_evaluations_of_every_recipe_are_counted(world, name):
    look, views = world
    report = evaluate(task(look, views[:1], recipes=(name,), scales=(0.5,), ceiling=False))
    assert report.measurements[0].evaluations > 0


FIGURES = (CONSISTENCY, ENERGY, FLICKER)


def test_figures_without_a_photograph_are_those_taken_by_hand(world):
    look, views = world
    report = evaluate(task(look, views, metrics=FIGURES))
    full, small = drawn(look, views[0]), drawn(look, views[0].scaled(0.5))
    values = report.select("classic", 0.5)[0].values
    expected = psnr(small.clamp(0, 1), box_average(full.clamp(0, 1), 2))
    assert values["consistency"] == pytest.approx(expected, abs=1e-6)
    light = torch.tensor([0.2126, 0.7152, 0.0722]).double()
    gained = (small.double() @ light).mean() / (full.double() @ light).mean() - 1
    assert values["energy drift"] == pytest.approx(float(gained), abs=1e-6)
    assert report.select("classic", 1.0)[0].values["energy drift"] == 0
    assert report.select("classic", 1.0)[0].values["consistency"] is None
    without = evaluate(task(look, views[:1], scales=(0.5,), metrics=FIGURES[:2]))  # the training size
    assert set(without.select("classic", 0.5)[0].values.values()) == {None}


def test_flicker_of_supersampling_is_nearer_to_motion_alone(world):
    look, views = world
    recipes = [RECIPES["ewa"], find_recipe("auto", quality="best")]
    report = evaluate(task(look, views[:1], recipes=recipes, scales=(0.25,), metrics=(FLICKER,)))
    far, near = (abs(report.select(r.name, 0.25)[0].values["flicker"] - 1) for r in recipes)
    assert near < far
    assert near < 0.05


@pytest.mark.parametrize("name", ["distance", "fov"])
def test_moved_cameras_are_compared_with_the_supersampled_look(world, name):
    recipes = ["classic", find_recipe("matched", rate_reference="interval")]
    report = evaluate(task(*world, "self", name, recipes, scales=(1.0, 0.25)))
    assert report.recipes == ("classic", "matched")  # the truth is its own ceiling
    classic, matched = (mean(report.select(r, 0.25), "PSNR") for r in report.recipes)
    assert matched > classic + 3
    assert report.protocol["protocol"]["scale changes"] == name


def test_a_protocol_names_its_flavours_in_every_result(world):
    look, views = world
    report = evaluate(task(look, views[:1], protocol="360-zoom-out", scales=(1.0, 0.5)))
    assert results(report)["_aaplug"]["metrics"]["SSIM"] == SSIM["3dgs"].protocol
    assert "Pillow" in per_view(report)["_aaplug"]["downscale"]


def test_views_of_one_name_are_told_apart(world):
    look, views = world
    twins = [replace(view, name="same") for view in views]
    report = evaluate(task(look, twins, scales=(0.5,)))
    assert list(per_view(report)["classic@0.5"]["PSNR"]) == ["00000_same", "00001_same"]


class StoppedError(Exception):
    pass


def test_an_interrupted_evaluation_continues_and_redoes_nothing(world, tmp_path, monkeypatch):
    look, views = world
    told = []
    whole = evaluate(task(look, views), tell=lambda *counts: told.append(counts), journal=tmp_path / "whole.jsonl")
    assert told == [(0, 2), (1, 2), (2, 2)]
    path = tmp_path / "progress.jsonl"

    def stop(done: int, total: int) -> None:
        if done == 1:
            raise StoppedError

    with pytest.raises(StoppedError):
        evaluate(task(look, views), tell=stop, journal=path)
    before = path.read_bytes()
    seen, render = [], Renderer.draw
    monkeypatch.setattr(Renderer, "draw", lambda self, view: (seen.append(view.name), render(self, view))[1])
    report = evaluate(task(look, views), journal=path, resume=True)
    assert set(seen) == {"b"}
    assert path.read_bytes().startswith(before)

    def timeless(report):
        return [replace(m, seconds=0.0) for m in report.measurements]

    assert timeless(report) == timeless(whole)
    seen.clear()
    assert evaluate(task(look, views), journal=path, resume=True) == report
    assert not seen


def test_images_lie_where_3dgs_scripts_look(world, tmp_path):
    look, views = world
    store = ImageStore(tmp_path, shown=(1,), everything=True)
    evaluate(task(look, views), images=store)
    every = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png"))
    assert "test/classic@0.5/renders/00000.png" in every
    assert "test/classic@0.5/gt/00001.png" in every
    assert not any("@2/" in path for path in every if path.startswith("test"))  # no truth there
    assert "images/ceiling@0.5/renders/00001.png" in every
    assert not any(path.endswith("00000.png") for path in every if path.startswith("images"))
    stored = read_image(store.path(1, "matched", 0.5), None)
    image = drawn(look, views[1].scaled(0.5), "matched")
    assert stored.equal(quantised(image))


# metrics that the registry does not know beforehand


def test_a_new_metric_that_is_undefined_is_reported_with_its_own_words(world, monkeypatch):
    monkeypatch.setattr(METRICS, "_entries", dict(METRICS))
    monkeypatch.setattr("aaplug.core.registry._registered", {kind: [] for kind in KINDS})
    odd = Metric("odd", "", 1.0, 2, "its protocol", lambda image, truth: None, undefined="too odd")
    nan = replace(odd, name="nan", measure=lambda image, truth: float("nan"), undefined="not finite")
    METRICS.register("odd", odd)  # and `nan` is given from Python alone
    look, views = world
    work = task(look, views[:1], scales=(0.5,), metrics=(PSNR, odd, nan))
    report = evaluate(work, journal=views[0].photo.with_name("odd.jsonl"))
    found = report.select("classic", 0.5)[0]
    assert (found.values["odd"], found.values["nan"]) == (None, None)
    assert found.note == "too odd; not finite"
    assert results(report)["_aaplug"]["notes"] == ["too odd; not finite"]
    assert len(tables(report)) == 5


# candidates side by side


def test_candidates_compare_as_by_hand(world):
    look, views = world
    other = replace(look, background=(1.0, 1.0, 1.0))  # so it is drawn anew
    truth = Truth(look, memory=1e9)
    candidates = [Candidate("own", look), Candidate("other", other)]
    report = compare(candidates, views, (1.0, 0.5), truth)
    assert report.recipes == ("own", "other")
    small = views[1].scaled(0.5)
    wanted = quantised(box_average(look(views[1]).rgb.clamp(0, 1), 2).to(KEPT).float())
    assert report.select("own", 1.0)[0].values["PSNR"] > 60  # but for the float16 of the kept truth
    found = report.select("other", 0.5)[1].values["PSNR"]
    assert found == pytest.approx(psnr(quantised(other(small).rgb), wanted), abs=1e-9)


def test_each_candidate_is_drawn_with_the_bounds_of_its_own_scene(world):
    look, views = world
    grown = make_scene(200, seed=1)
    bare = [replace(view, photo=None) for view in views]
    report = compare_scenes(
        {"original": look.scene, "again": look.scene, "grown": grown},
        CameraSet(tuple(bare), tuple(bare)),
        recipe="matched",
        scale=(1.0, 0.5),
        metric=("psnr", "ssim"),
        rasterizer="eager",
    ).report
    assert report.protocol["truth"] == "reference"
    assert mean(report.select("original", 1.0), "SSIM") == pytest.approx(1.0)
    assert report.select("again", 0.5)[0].values == report.select("original", 0.5)[0].values
    assert mean(report.select("original", 0.5), "PSNR") is None
    assert mean(report.select("grown", 0.5), "PSNR") < 60


# the truth


def test_the_truth_without_photographs_draws_its_look_once(world, monkeypatch):
    look, views = world
    drawings = []
    call = TimedRenderer.__call__
    monkeypatch.setattr(TimedRenderer, "__call__", lambda self, view: (drawings.append(view), call(self, view))[1])
    work = task(look, views[:1], "self", recipes=("matched", "auto"), scales=(1.0, 0.5))
    evaluate(work)
    # at the training size both draw what the truth does; below it, auto weighs samples with their neighbours
    assert [view.hw for view in drawings] == [(48, 64), (24, 32), (24, 32)]


def test_a_kept_truth_is_made_once_and_a_full_memory_keeps_nothing(world):
    look, views = world
    kept, forgetful = Truth(look, memory=1e9), Truth(look, memory=0.0)
    image = kept(views[0], 0.25)
    assert kept(views[0], 0.25).equal(image)
    assert len(kept._kept) == 1
    assert forgetful(views[0], 0.25).equal(image)
    assert not forgetful._kept
    assert image.equal(Truth(look)(views[0], 0.25).to(KEPT).float())
    namesake = replace(views[1], name=views[0].name)  # as in Blender's splits
    assert not kept(namesake, 0.25).equal(image)


def test_cached_images_lie_together_in_memory():
    """Each in a block of its own kept gigabytes of freed renders from the system."""
    cameras = [make_camera((x, -4.0, 0.5)) for x in (0.0, 1.0, 2.0)]
    truth = Truth(own_look(make_scene(50), TrainingViews.of(make_scene(50), cameras), "eager"), memory=1e6)
    images = [truth(camera, scale) for camera in cameras for scale in (0.5, 0.25)]
    kept = list(truth._kept.values())
    assert len({image.untyped_storage().data_ptr() for image in kept}) == 1
    for image, cached in zip(images, kept, strict=True):
        torch.testing.assert_close(image, cached.float(), rtol=0, atol=0)
    full = Truth(truth.own, memory=float(kept[0].nbytes))
    for camera in cameras:
        full(camera, 0.5)
    assert len(full._kept) == 1


def test_larger_truth_has_the_averages_of_the_training_size(world):
    look, views = world
    full, larger = look(views[0]).rgb, Truth(look, enlarge=back_projected)(views[0], 2.0)
    off = [(box_average(image, 2) - full).square().mean() for image in (larger, look(views[0].scaled(2.0)).rgb)]
    assert off[0] < 0.2 * off[1]


def test_what_a_recipe_draws_by_is_part_of_the_request(world, tmp_path):
    look, views = world
    first, changed = (task(look, views[:1], recipes=[replace(RECIPES["mip"], grid=grid)]) for grid in (1, 2))
    evaluate(first, journal=tmp_path / "journal")
    with pytest.raises(UsageError, match=r"another request \(recipes_sha256 changed"):
        evaluate(changed, journal=tmp_path / "journal", resume=True)
