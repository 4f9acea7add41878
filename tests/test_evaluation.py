"""Evaluation: what is compared with what, and what the report holds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug.core.cameras import BLACK
from aaplug.core.errors import UsageError
from aaplug.evaluation.engine import NO_PHOTOGRAPH, Task, evaluate
from aaplug.evaluation.image_store import Images
from aaplug.evaluation.metrics import CONSISTENCY, ENERGY, FLICKER, SSIM, psnr
from aaplug.evaluation.protocols import PROTOCOLS
from aaplug.evaluation.results import CEILING, as_csv, mean, per_view, results, scale_name, tables
from aaplug.io.images import downsample, quantised, read_image, write_png
from aaplug.methods.recipes import RECIPES, find_recipe
from aaplug.rasterizers import RASTERIZERS
from aaplug.rendering.renderer import learn, render
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
    look, views = world
    report = evaluate(scene, training, task(views))
    for view in views:
        photo = quantised(read_image(view.photo, None))
        for scale, truth in ((1.0, photo), (0.5, downsample(photo, 2))):
            image = render(scene, view.scaled(scale), RECIPES["classic"], training).rgb
            found = next(m for m in report.select("classic", scale) if m.view == view.name)
            assert found.values["PSNR"] == pytest.approx(psnr(quantised(image), truth), abs=1e-9)


def test_the_ceiling_is_always_among_the_rows(world):
    look, views = world
    report = evaluate(scene, training, task(views))
    assert report.recipes == (CEILING, "classic", "matched")
    full = render(scene, views[0], RECIPES["classic"], training).rgb.clamp(0, 1)
    expected = psnr(
        quantised(downsample(full, 2)), downsample(quantised(read_image(views[0].photo, None)), 2)
    )
    assert report.select(CEILING, 0.5)[0].values["PSNR"] == pytest.approx(expected, abs=1e-9)


def test_above_the_photographs_size_metrics_are_undefined_and_say_why(world):
    look, views = world
    report = evaluate(scene, training, task(views))
    assert mean(report.select("matched", 2.0), "PSNR") is None
    assert results(report)["matched@2"] == {"PSNR": None, "SSIM": None}
    assert results(report)["_aaplug"]["notes"] == [NO_PHOTOGRAPH]


def test_self_truth_needs_no_photographs_and_makes_the_ceiling_perfect(world):
    look, views = world
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
    look, views = world
    with pytest.raises(UsageError, match="a: has no photograph"):
        evaluate(scene, training, task([replace(views[0], photo=None)]))


@pytest.mark.parametrize("changes", [{"scales": ()}, {"scales": (0.0,)}, {"scales": (1.0, 1.0)}])
def test_empty_or_doubled_work_is_refused(world, changes):
    look, views = world
    with pytest.raises(UsageError):
        evaluate(scene, training, task(views, **changes))


def test_per_view_has_every_view_and_results_their_mean(world):
    look, views = world
    report = evaluate(scene, training, task(views, scales=(0.5,)))
    values = per_view(report)["matched@0.5"]["PSNR"]
    assert list(values) == ["a", "b"]
    assert results(report)["matched@0.5"]["PSNR"] == pytest.approx(sum(values.values()) / 2)


def test_tables_show_every_recipe_and_scale(world):
    look, views = world
    report = evaluate(scene, training, task(views))
    for table in tables(report):
        assert table.row_count == 3
        assert [column.header for column in table.columns] == ["recipe", "1", "1/2", "2×"]


def test_progress_counts_views(world):
    look, views = world
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
    look, views = world
    reports = [evaluate(scene, training, task(views, scales=(0.5,))) for _ in range(2)]
    values = [[m.values for m in report.measurements] for report in reports]
    assert values[0] == values[1]
    assert all(torch.tensor(m.seconds) > 0 for m in reports[0].measurements)


def test_pairs_are_counted_and_fewer_where_images_are_smaller(world):
    look, views = world
    report = evaluate(scene, training, task(views))
    for recipe in ("classic", "matched"):
        small, full = (report.select(recipe, scale)[0].pairs for scale in (0.5, 1.0))
        assert 0 < small < full
    reference = task(views[:1], scales=(0.5,), rasterizer=RASTERIZERS["reference"])
    assert evaluate(scene, training, reference).measurements[0].pairs is None


@pytest.mark.parametrize("name", [n for n, r in RECIPES.items() if r.selection is None])
def test_the_pairs_of_every_recipe_are_counted(world, name):
    look, views = world
    chosen = replace(task(views[:1], scales=(0.5,)), recipes=[RECIPES[name]])
    (found,) = evaluate(scene, training, chosen).select(name, 0.5)
    assert found.pairs is not None
    assert found.pairs > 0


FIGURES = (CONSISTENCY, ENERGY, FLICKER)


def test_figures_without_a_photograph_are_those_taken_by_hand(world):
    look, views = world
    report = evaluate(scene, training, task(views, figures=FIGURES))
    full = render(scene, views[0], RECIPES["classic"], training)
    small = render(scene, views[0].scaled(0.5), RECIPES["classic"], training)
    values = report.select("classic", 0.5)[0].values
    expected = psnr(small.rgb.clamp(0, 1), downsample(full.rgb.clamp(0, 1), 2))
    assert values["consistency"] == pytest.approx(expected, abs=1e-6)
    light = torch.tensor([0.2126, 0.7152, 0.0722]).double()
    gained = (small.rgb.double() @ light).mean() / (full.rgb.double() @ light).mean() - 1
    assert values["energy drift"] == pytest.approx(float(gained), abs=1e-6)
    assert report.select("classic", 1.0)[0].values["energy drift"] == 0
    assert report.select("classic", 1.0)[0].values["consistency"] is None


def test_flicker_of_supersampling_is_nearer_to_motion_alone(world):
    look, views = world
    recipes = [RECIPES["ewa"], find_recipe("auto", quality="best")]
    work = replace(task(views[:1], scales=(0.25,), figures=(FLICKER,)), recipes=recipes)
    report = evaluate(scene, training, work)
    far, near = (abs(report.select(r.name, 0.25)[0].values["flicker"] - 1) for r in recipes)
    assert near < far
    assert near < 0.05


def test_figures_need_scale_1_and_are_null_without(world):
    look, views = world
    report = evaluate(scene, training, task(views[:1], scales=(0.5,), figures=FIGURES[:2]))
    assert mean(report.select("classic", 0.5), "consistency") is None
    assert mean(report.select("classic", 0.5), "energy drift") is None


@pytest.mark.parametrize("name", ["distance", "fov"])
def test_moved_cameras_are_judged_by_the_supersampled_look(world, name):
    look, views = world
    recipes = [RECIPES["classic"], find_recipe("matched", rate="interval")]
    work = replace(
        task(views, scales=(1.0, 0.25), truth="self", protocol=PROTOCOLS[name]), recipes=recipes
    )
    report = evaluate(scene, training, work)
    assert report.recipes == ("classic", "matched")  # the truth is its own ceiling
    classic, matched = (mean(report.select(r.name, 0.25), "PSNR") for r in recipes)
    assert matched > classic + 3
    assert report.protocol["protocol"]["scale changes"] == name


def test_a_protocol_names_its_flavours_in_every_result(world):
    look, views = world
    work = task(views[:1], scales=(1.0, 0.5), protocol=PROTOCOLS["360-zoom-out"])
    report = evaluate(scene, training, work)
    assert results(report)["_aaplug"]["metrics"]["SSIM"] == SSIM["3dgs"].protocol
    assert "Pillow" in per_view(report)["_aaplug"]["downscale"]
    plain = evaluate(scene, training, task(views[:1], scales=(1.0, 0.5)))
    for r in (1.0, 0.5):
        assert (
            report.select("classic", r)[0].values["SSIM"]
            != plain.select("classic", r)[0].values["SSIM"]
        )


def test_photographs_do_not_show_moved_cameras(world):
    look, views = world
    with pytest.raises(UsageError, match="moves the camera"):
        evaluate(scene, training, task(views, protocol=PROTOCOLS["fov"]))


def test_views_of_one_name_are_told_apart(world):
    look, views = world
    twins = [replace(view, name="same") for view in views]
    report = evaluate(scene, training, task(twins, scales=(0.5,)))
    assert list(per_view(report)["classic@0.5"]["PSNR"]) == ["00000_same", "00001_same"]


class StoppedError(Exception):
    pass


def test_an_interrupted_evaluation_continues_and_redoes_nothing(world, tmp_path, monkeypatch):
    look, views = world
    whole = evaluate(scene, training, task(views), record=tmp_path / "whole.jsonl")
    path = tmp_path / "progress.jsonl"

    def stop(done: int, total: int) -> None:
        if done == 1:
            raise StoppedError

    with pytest.raises(StoppedError):
        evaluate(scene, training, task(views), progress=stop, record=path)
    before = path.read_bytes()
    drawn = []
    monkeypatch.setattr(
        "aaplug.evaluation.engine.render",
        lambda *args: (drawn.append(args[1].name), render(*args))[1],
    )
    report = evaluate(scene, training, task(views), record=path, resume=True)
    assert set(drawn) == {"b"}
    assert path.read_bytes().startswith(before)

    def timeless(report):
        return [replace(m, seconds=0.0) for m in report.measurements]

    assert timeless(report) == timeless(whole)
    drawn.clear()
    assert evaluate(scene, training, task(views), record=path, resume=True) == report
    assert not drawn


def test_images_lie_where_3dgs_scripts_look(world, tmp_path):
    look, views = world
    store = Images(tmp_path, shown=(1,), everything=True)
    evaluate(scene, training, task(views), images=store)
    every = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png"))
    assert "test/classic@0.5/renders/00000.png" in every
    assert "test/classic@0.5/gt/00001.png" in every
    assert not any("@2/" in path for path in every if path.startswith("test"))  # no truth there
    assert "images/ceiling@0.5/renders/00001.png" in every
    assert not any(path.endswith("00000.png") for path in every if path.startswith("images"))
    stored = read_image(store.path(1, "matched", 0.5), None)
    image = render(scene, views[1].scaled(0.5), RECIPES["matched"], training).rgb
    assert stored.equal(quantised(image))


def test_csv_holds_a_line_a_measurement(world):
    look, views = world
    report = evaluate(scene, training, task(views))
    lines = as_csv({'a "scene"': report}).splitlines()
    assert lines[0] == "scene,protocol,recipe,scale,view,PSNR,SSIM,samples,pairs,seconds,note"
    assert len(lines) == 1 + len(report.measurements)
    assert lines[1].startswith('"a ""scene""",default,"training size, resampled",1,a,')
