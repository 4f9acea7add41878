"""Evaluation: what is compared with what, what a scale does to a camera, what the report and the journal hold."""

import json
import math
from dataclasses import fields, replace
from types import SimpleNamespace

import pytest
import torch

from aaplug import METRICS, PROTOCOLS, RASTERIZERS, RECIPES, TrainingViews, find_recipe, read_image, write_png
from aaplug.core.camera_paths import median_depth
from aaplug.core.cameras import Camera, Exposure, Undistortion
from aaplug.core.colours import WHITE
from aaplug.core.imaging import box_average, quantised
from aaplug.core.lenses import EQUIDISTANT
from aaplug.evaluation.engine import Task, evaluate, renderers_of
from aaplug.evaluation.image_store import ImageStore
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.metric import Metric, TimedRenderer
from aaplug.evaluation.metrics import CONSISTENCY, ENERGY, FLICKER, PSNR, SSIM, psnr
from aaplug.evaluation.results import (
    CEILING,
    NO_PHOTOGRAPH,
    Measurement,
    as_csv,
    mean,
    method,
    metric_grid,
    per_view,
    results,
    scale_name,
    tables,
)
from aaplug.evaluation.truth import Truth, ViewTruth, back_projected
from aaplug.io.photographs import DOWNSCALES
from aaplug.lab.gaussian_blending import GAUSSIAN_BLENDING
from aaplug.rendering.renderer import Renderer, own_look
from aaplug.system.errors import FormatError, OutputError, UsageError
from tests.conftest import make_camera, make_scene, with_photographs

VIEWS = (make_camera((0.0, -4.0, 0.0), name="a"), make_camera((2.0, -4.0, 1.0), name="b"))


@pytest.fixture(scope="module")
def look():
    return own_look(scene := make_scene(150), TrainingViews.of(scene, VIEWS), "eager")


@pytest.fixture(scope="module")
def views(look, tmp_path_factory):
    """Their photographs are slightly brightened renders."""
    classic = replace(look, recipe=RECIPES["classic"])
    return with_photographs(classic, VIEWS, tmp_path_factory.mktemp("photos"), 0.9, 0.05).test


def drawn(look, view, recipe="classic"):
    return replace(look, recipe=RECIPES[recipe])(view).rgb


def task(look, views, source="photographs", protocol="default", recipes=("classic", "matched"), **changes):
    recipes = [find_recipe(recipe) if isinstance(recipe, str) else recipe for recipe in recipes]
    renderers = renderers_of(look, recipes)
    truth = Truth(look, source, PROTOCOLS[protocol])
    return Task(**({"renderers": renderers, "scales": (1.0, 0.5, 2.0), "views": views, "truth": truth} | changes))


def test_figures_are_those_of_the_images_compared_by_hand(look, views):
    report = evaluate(task(look, views))
    assert report.recipes == (CEILING, "classic", "matched")
    for place, view in enumerate(views):
        photo = quantised(read_image(view.photo, None))
        half = box_average(photo, 2)
        for recipe, scale, image, truth in (
            (CEILING, 0.5, box_average(drawn(look, view).clamp(0, 1), 2), half),
            ("classic", 1.0, drawn(look, view), photo),
            ("classic", 0.5, drawn(look, view.scaled(0.5)), half),
        ):
            found = report.select(recipe, scale)[place].values["PSNR"]
            assert found == pytest.approx(psnr(quantised(image), truth), abs=1e-9)


def test_self_truth_needs_no_photographs_and_makes_the_ceiling_perfect(look, views):
    bare = [replace(view, photo=None) for view in views]
    report = evaluate(task(look, bare, "self"))
    assert mean(report.select(CEILING, 0.5), "PSNR") is None  # equal images
    assert mean(report.select(CEILING, 0.5), "SSIM") == pytest.approx(1.0)
    assert mean(report.select("matched", 2.0), "PSNR") is None  # its own truth above the training size
    assert mean(report.select("classic", 2.0), "PSNR") < 40
    assert mean(report.select("matched", 0.5), "PSNR") > mean(report.select("classic", 0.5), "PSNR")


def test_work_without_a_truth_empty_or_doubled_is_refused(look, views):
    bare, nothing = [replace(views[0], photo=None)], {"none": replace(look, scene=look.scene[:0])}
    for given, changes, words in (
        (views, {"renderers": nothing}, "has no Gaussians to measure"),
        (views, {"scales": ()}, "needs at least"),
        (views, {"scales": (0.0,)}, "above 0"),
        (views, {"scales": (1.0, 1.0)}, "named twice"),
        (views, {"recipes": ("auto", "auto")}, "a recipe is named twice"),
        (bare, {}, "a: has no photograph"),
        (views, {"protocol": "fov"}, "moves the camera"),
        (views, {"protocol": "blender", "scales": (1.0, 0.3)}, "scale: 0.3 is not a power of 1/2"),
    ):
        with pytest.raises(UsageError, match=words):
            task(look, given, **changes)


def test_reports_hold_every_view_recipe_and_scale(look, views):
    report = evaluate(task(look, views))
    values = per_view(report)["matched@0.5"]["PSNR"]
    assert list(values) == ["a", "b"]
    assert results(report)["matched@0.5"]["PSNR"] == pytest.approx(sum(values.values()) / 2)
    grids = [table for table in tables(report) if not isinstance(table, str)]
    for table in grids:
        assert table.row_count == 3
        assert [column.header for column in table.columns] == ["recipe", "1", "1/2", "2×"]
    lines = [f"no {name} at 2×: {NO_PHOTOGRAPH}" for name in ("PSNR", "SSIM")]
    assert (len(grids), [table for table in tables(report) if isinstance(table, str)]) == (4, lines)
    other = replace(report, measurements=tuple(replace(m, note="") for m in report.measurements))
    cells = [["30", "–", "–"]] * 3
    assert NO_PHOTOGRAPH in metric_grid("of two scenes", [other, report], report.metrics[0], cells)[-1]
    assert NO_PHOTOGRAPH not in metric_grid("of one", [other], report.metrics[0], cells)[-1]
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


COUNTED = {(r.pixel.name, r.compositor): n for n, r in RECIPES.items() if not r.lacks(make_scene(1))}


@pytest.mark.parametrize("name", COUNTED.values())
def test_evaluations_of_every_kernel_and_compositor_are_counted_and_fewer_where_images_are_smaller(look, views, name):
    report = evaluate(task(look, views[:1], recipes=(name,), scales=(0.5, 1.0), ceiling=False))
    small, full = (report.select(name, scale)[0].evaluations for scale in (0.5, 1.0))
    assert 0 < small < full


def test_a_rasterizer_that_does_not_count_and_a_compositor_without_kernels_have_no_evaluations(look, views):
    slow = replace(look, rasterizer=RASTERIZERS["reference"])
    assert evaluate(task(slow, views[:1], scales=(0.5,))).measurements[0].evaluations is None

    def tiles(rows, window, order, first, counts, centres, *_):
        return torch.zeros(4, *centres[0].shape)

    plain = SimpleNamespace(name="plain", rows=GAUSSIAN_BLENDING.rows, tiles=tiles, exact=GAUSSIAN_BLENDING.exact)
    recipe = replace(RECIPES["classic"], compositor=plain)
    assert TimedRenderer(replace(look, recipe=recipe))(views[0].scaled(0.5)).evaluations is None


FIGURES = (CONSISTENCY, ENERGY, FLICKER)


def test_figures_without_a_photograph_are_those_taken_by_hand(look, views):
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
    assert "no consistency at 1/2: it needs scale 1 among the scales" in tables(without)
    assert "no consistency at 1, 2×: it needs a scale below the training size" in tables(report)


def test_flicker_of_supersampling_is_nearer_to_motion_alone(look, views):
    recipes = [RECIPES["ewa"], find_recipe("auto", quality="best")]
    report = evaluate(task(look, views[:1], recipes=recipes, scales=(0.25,), metrics=(FLICKER,)))
    far, near = (abs(report.select(r.name, 0.25)[0].values["flicker"] - 1) for r in recipes)
    assert near < far
    assert near < 0.05


@pytest.mark.parametrize("name", ["distance", "fov"])
def test_moved_cameras_are_compared_with_the_supersampled_look(look, views, name):
    recipes = ["classic", find_recipe("matched", rate_reference="interval")]
    report = evaluate(task(look, views, "self", name, recipes, scales=(1.0, 0.25)))
    assert report.recipes == ("classic", "matched")  # the truth is its own ceiling
    classic, matched = (mean(report.select(r, 0.25), "PSNR") for r in report.recipes)
    assert matched > classic + 3
    assert report.protocol["protocol"]["scale changes"] == name


def test_a_protocol_names_its_flavours_and_views_of_one_name_are_told_apart(look, views):
    twins = [replace(view, name="same") for view in views]
    report = evaluate(task(look, twins, protocol="360-zoom-out", scales=(0.5,)))
    assert results(report)["_aaplug"]["metrics"]["SSIM"] == SSIM["3dgs"].protocol
    assert "Pillow" in per_view(report)["_aaplug"]["downscale"]
    assert list(per_view(report)["classic@0.5"]["PSNR"]) == ["00000_same", "00001_same"]


def test_an_interrupted_evaluation_continues_and_redoes_nothing(look, views, tmp_path, monkeypatch):
    told = []
    whole = evaluate(task(look, views), tell=lambda *counts: told.append(counts), journal=tmp_path / "whole.jsonl")
    assert told == [(0, 2), (1, 2), (2, 2)]
    path = tmp_path / "progress.jsonl"

    def stop(done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(task(look, views), tell=stop, journal=path)
    before = path.read_bytes()
    seen, draw = [], Renderer.draw
    monkeypatch.setattr(Renderer, "draw", lambda self, view: (seen.append(view.name), draw(self, view))[1])
    report = evaluate(task(look, views), journal=path, resume=True)
    assert set(seen) == {"b"}
    assert path.read_bytes().startswith(before)

    def timeless(report):
        return [replace(m, seconds=0.0) for m in report.measurements]

    assert timeless(report) == timeless(whole)
    seen.clear()
    assert evaluate(task(look, views), journal=path, resume=True) == report
    assert not seen


EDITS = [
    ("view", 0),  # a view that is there
    ("view", 2),  # a view that is not
    ("view", -1),  # a negative view
    ("view", True),  # no view
    ("view", 1.5),  # a part of a view
    ("recipe", "mip"),  # another recipe
    ("scale", 0.75),  # another scale
    ("name", "a"),  # another name
    ("values", {"PSNR": 30.0, "FLIP": 0.1}),  # another metric
    ("values", {"PSNR": 30.0}),  # a metric less
    ("values", {"PSNR": 30.0, "SSIM": 0.9}),  # other numbers
    ("seconds", 1.0),  # another time
    ("values", {"PSNR": math.nan, "SSIM": 1.0}),  # no number
    ("seconds", math.inf),  # no finite time
    ("samples", None),  # no samples
    ("measurements", []),  # a measurement less
]


DAMAGED = ("{}", "[]", '{"view": 0}', '{"view": 0, "measurements": [{}]}', '{"view": [], "measurements": []}')


def test_a_journal_that_was_edited_by_hand_is_refused(look, views, tmp_path):
    path = tmp_path / "progress.jsonl"
    work = task(look, views, scales=(1.0, 0.5), recipes=("classic",), ceiling=False)
    evaluate(work, journal=path)
    *kept, last = path.read_text().splitlines()
    damaged = [*DAMAGED]
    for key, value in EDITS:
        line = json.loads(last)
        if key in line:
            line[key] = value
        else:
            line["measurements"][1]["view" if key == "name" else key] = value
        damaged.append(json.dumps(line))
    for line in damaged:
        path.write_text("\n".join([*kept, line, ""]))
        with pytest.raises(FormatError, match="3 is damaged, or of another aaplug; remove the file to start again"):
            evaluate(work, journal=path, resume=True)


def test_images_lie_where_3dgs_scripts_look(look, views, tmp_path):
    store = ImageStore(tmp_path, report_views=(1,), everything=True)
    evaluate(task(look, views), images=store)
    every = sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.png"))
    assert "test/classic@0.5/renders/00000.png" in every
    assert "test/classic@0.5/gt/00001.png" in every
    assert not any("@2/" in path for path in every if path.startswith("test"))  # no truth there
    assert f"images/{method(CEILING, 0.5)}/renders/00001.png" in every
    assert not any(path.endswith("00000.png") for path in every if path.startswith("images"))
    stored = read_image(store.path(1, "matched", 0.5), None)
    image = drawn(look, views[1].scaled(0.5), "matched")
    assert stored.equal(quantised(image))


def test_a_new_metric_that_is_undefined_is_reported_with_its_own_words(look, views, monkeypatch):
    monkeypatch.setattr(METRICS, "_entries", dict(METRICS))
    odd = Metric("odd", "", 1.0, 2, "its protocol", lambda image, truth: None, undefined="too odd")
    nan = replace(odd, name="nan", measure=lambda image, truth: float("nan"), undefined="not finite")
    METRICS.register("odd", odd)  # and `nan` is given from Python alone
    work = task(look, views[:1], scales=(0.5,), metrics=(PSNR, odd, nan))
    report = evaluate(work, journal=views[0].photo.with_name("odd.jsonl"))
    found = report.select("classic", 0.5)[0]
    assert (found.values["odd"], found.values["nan"]) == (None, None)
    assert found.note == "too odd; not finite"
    assert results(report)["_aaplug"]["notes"] == ["too odd; not finite"]
    assert str(tables(report)[0].title).endswith(", photographs, 1 view")
    lines = ["no odd at 1/2: too odd", "no nan at 1/2: not finite"]
    assert (len(tables(report)), tables(report)[1:3]) == (5, lines)


def test_renderers_compare_as_by_hand(look, views):
    other = replace(look, background=(1.0, 1.0, 1.0))  # so it is drawn anew
    report = evaluate(Task({"own": look, "other": other}, (1.0, 0.5), views, Truth(look, memory=1e9), ceiling=False))
    assert report.recipes == ("own", "other")
    assert PSNR.undefined in report.select("own", 1.0)[0].note
    wanted = quantised(box_average(look(views[1]).rgb.clamp(0, 1), 2))
    expected = psnr(quantised(other(views[1].scaled(0.5)).rgb), wanted)
    assert report.select("other", 0.5)[1].values["PSNR"] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("source", ["photographs", "self"])
def test_a_cached_truth_is_compared_as_one_that_is_not(look, views, source):
    for scale in (1.0, 0.5):
        cached, fresh = (ViewTruth(Truth(look, source, memory=m), views[0]).compared(scale) for m in (1e9, None))
        slack = 0.501 / 65535 if source == "photographs" and scale < 1 else 0  # the others have 8 bits
        torch.testing.assert_close(cached, fresh, rtol=0, atol=slack)


def test_the_truth_without_photographs_draws_its_look_once(look, views, monkeypatch):
    drawings = []
    call = TimedRenderer.__call__
    monkeypatch.setattr(TimedRenderer, "__call__", lambda self, view: (drawings.append(view), call(self, view))[1])
    work = task(look, views[:1], "self", recipes=("matched", "auto"), scales=(1.0, 0.5))
    evaluate(work)
    # at the training size both draw what the truth does; below it, auto weighs samples with their neighbours
    assert [view.hw for view in drawings] == [(48, 64), (24, 32), (24, 32)]


def test_a_cached_truth_is_made_once_and_lies_with_others_in_memory(look, views):
    """Each in a block of its own kept gigabytes of freed renders from the system."""
    views = [*views, replace(views[1], name=views[0].name)]  # a namesake, as in Blender's splits
    truth = Truth(look, memory=1e9)
    images = [truth(view, scale) for view in views[:2] for scale in (0.5, 0.25)]
    cached = list(truth.cache.values())
    for image, stored in zip(images, cached, strict=True):
        assert image.equal(stored.float() / 65535)
    assert len({image.untyped_storage().data_ptr() for image in cached}) == 1
    assert truth(views[2], 0.25).equal(images[3])
    assert len(truth.cache) == 4
    torch.testing.assert_close(images[1], Truth(look)(views[0], 0.25), rtol=0, atol=0.501 / 65535)


def test_the_cache_tells_views_apart_by_all_that_their_images_depend_on(look, views, monkeypatch):
    view, truth = views[0], Truth(look, memory=1e9)
    monkeypatch.setattr(ViewTruth, "_image", lambda made, _: torch.full((1, 1, 3), float(made.view is not view)))
    pose = view.cam_from_world.clone()
    pose[0, 3] += 1
    bent = Undistortion(EQUIDISTANT, view.hw, (1.0,) * 4, (0, 0, *view.hw))
    others = {"photo": views[1].photo, "lens": EQUIDISTANT, "undistortion": bent, "cam_from_world": pose}
    others |= {"trained_focal": 7.0, "name": "other", "exposure": Exposure(samples=2)}
    for field in fields(Camera):
        value = getattr(view, field.name)
        other = replace(view, **{field.name: others[field.name] if field.name in others else type(value)(value + 1)})
        truth(view, 1.0)
        assert bool(truth(other, 1.0).any()) == (field.name != "name"), field.name


@pytest.mark.parametrize("room", [0, 1])
def test_a_full_memory_caches_nothing_more(look, views, room):
    bytes_of_one = look(views[0].scaled(0.5)).rgb.nbytes / 2
    truth = Truth(look, memory=room * bytes_of_one)
    first, second = (truth(view, 0.5) for view in views)
    assert len(truth.cache) == room
    assert truth(views[0], 0.5).equal(first)
    assert not truth(views[1], 0.5).equal(first)
    assert truth(views[1], 0.5).equal(second)


@pytest.mark.parametrize(("size", "width", "scale"), [((65, 49), 32, 0.5), ((8, 6), 30, 4.0)])
def test_a_photograph_is_large_enough_where_its_size_or_its_views_was_rounded(
    look, views, tmp_path, size, width, scale
):
    write_png(tmp_path / "photo.png", torch.full((24, width, 3), 0.2))
    view = ViewTruth(Truth(look, "photographs"), replace(views[0].resized(*size), photo=tmp_path / "photo.png"))
    torch.testing.assert_close(view.image(scale), torch.full((24, 32, 3), 0.2))
    assert view.image(1.2 * scale) is None


def test_larger_truth_has_the_averages_of_the_training_size(look, views):
    full, larger = look(views[0]).rgb, Truth(look, enlarge=back_projected)(views[0], 2.0)
    off = [(box_average(image, 2) - full).square().mean() for image in (larger, look(views[0].scaled(2.0)).rgb)]
    assert off[0] < 0.2 * off[1]


def sharpness(weight):
    return Metric("sharpness", "", 0.0, 2, "mean", lambda image, truth: weight * float(image.mean()))


CHANGED = {
    "recipes_sha256.mip": [{"recipes": [replace(RECIPES["mip"], grid=grid)]} for grid in (1, 2)],
    "metrics_sha256.sharpness": [{"metrics": [sharpness(weight)]} for weight in (1, 2)],
}


@pytest.mark.parametrize("part", CHANGED)
def test_what_a_recipe_draws_by_and_a_metric_measures_by_is_part_of_the_request(look, views, tmp_path, part):
    first, changed = (task(look, views[:1], **choices) for choices in CHANGED[part])
    evaluate(first, journal=tmp_path / "journal")
    with pytest.raises(UsageError, match=rf"another aaplug \({part} changed"):
        evaluate(changed, journal=tmp_path / "journal", resume=True)


def test_recipes_rank_as_measured_on_the_sample(sample_scene, sample_cameras, sample_training):
    """The order that the project stands for, at 1/8 on one photograph; figures are in the README."""
    recipes = [RECIPES[name] for name in ("classic", "mip", "matched", "auto")]
    look = own_look(sample_scene, sample_training, "eager", WHITE)
    task = Task(renderers_of(look, recipes), (0.125,), sample_cameras.test[1:2], Truth(look, "photographs"), [PSNR])
    report = evaluate(task)
    dB = {name: mean(report.select(name, 0.125), "PSNR") for name in report.recipes}
    assert dB["classic"] + 7 < dB["mip"] < dB["matched"] < dB["auto"] - 6, dB
    assert dB["classic"] + 17 < dB["auto"]
    assert dB[CEILING] - dB["auto"] < 0.7


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=lambda p: p.name)
def test_every_protocol_samples_what_is_in_the_middle_by_the_scale_of_which_one_is_the_view_itself(protocol):
    view = make_camera((0.0, -4.0, 0.0))
    half, same, double = (protocol.camera(view, scale, 4.0) for scale in (0.5, 1.0, 2.0))
    for camera, scale in ((half, 0.5), (double, 2.0)):
        depth = camera.cam_from_world[2, 3].item()  # of the world's origin, which the view looks at
        assert camera.fx / depth == pytest.approx(scale * view.fx / 4.0)
    assert (same.hw, same.intrinsics) == (view.hw, view.intrinsics)
    assert same.cam_from_world.equal(view.cam_from_world)
    assert (protocol.downscale in DOWNSCALES, protocol.ssim in SSIM, bool(protocol.source)) == (True, True, True)


def test_cameras_of_moved_and_of_whole_sized_protocols():
    view = make_camera(size=(987, 743))
    assert PROTOCOLS["distance"].camera(view, 0.5, 4.0).trained_focal is None
    assert PROTOCOLS["fov"].camera(view, 0.5, 4.0).trained_focal == view.trained_focal
    assert PROTOCOLS["360-zoom-out"].camera(view, 0.25, 1.0).hw == (186, 247)  # rounded, as 3DGS does
    assert PROTOCOLS["default"].camera(view, 0.25, 1.0).hw == (185, 246)


def test_median_depth_is_of_what_the_view_shows():
    scene, view = make_scene(500), make_camera((0.0, -4.0, 0.0))
    depths = scene.means @ view.cam_from_world[2, :3].float() + view.cam_from_world[2, 3].float()
    assert depths.min() < median_depth(scene.means, view) < depths.max()
    backwards = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double()
    away = replace(view, cam_from_world=backwards @ view.cam_from_world)
    with pytest.raises(UsageError, match="sees no Gaussian"):
        median_depth(scene.means, away)


REQUEST = {"views": 3, "scales": [1.0, 0.1], "versions": {"aaplug": "1", "torch": "2"}}


def measured(view: str) -> Measurement:
    return Measurement("auto", 0.1, view, {"PSNR": 1 / 3, "SSIM": None}, 2, 0.125, "note", 7)


@pytest.fixture
def path(tmp_path):
    """A journal of two finished views."""
    with Journal(tmp_path / "r" / "progress.jsonl", REQUEST, resume=False) as journal:
        for i, name in enumerate("ab"):
            journal.add(i, [measured(name)])
    return journal.path


def test_what_is_finished_comes_back_to_the_bit_and_to_one_process_and_zeros_of_a_lost_disk_do_not(path):
    whole = path.read_bytes()
    path.write_bytes(whole + b"\0" * 50 + b"\n")
    with Journal(path, REQUEST, resume=True) as journal:
        assert journal.views == {0: (measured("a"),), 1: (measured("b"),)}
        with pytest.raises(UsageError, match="another process"):
            Journal(path, REQUEST, resume=True)
    assert path.read_bytes() == whole


@pytest.mark.parametrize(("end", "views"), [(-1, "a"), (-20, "a"), (-60, "a"), (10, "")])
def test_a_torn_line_is_forgotten_and_written_again(path, end, views):
    whole = path.read_bytes()
    path.write_bytes(whole[:end])
    with Journal(path, REQUEST, resume=True) as journal:
        assert len(journal.views) == len(views)
        for i, name in list(enumerate("ab"))[len(views) :]:
            journal.add(i, [measured(name)])
    assert path.read_bytes() == whole


def test_another_request_is_refused_by_what_changed_until_the_journal_is_begun_anew_or_removed(path):
    other = {"scales": [1.0], "views": 3, "versions": {"aaplug": "1", "torch": "3"}}
    with pytest.raises(UsageError, match=r"another aaplug \(scales, versions.torch changed.* or remove the file"):
        Journal(path, other, resume=True)
    with Journal(path, other, resume=False) as journal:
        journal.add(0, [measured("c")])
    assert len(path.read_text().splitlines()) == 2
    path.unlink()
    assert not Journal(path, other, resume=True).views


def test_nothing_is_made_before_the_first_view_and_a_place_that_cannot_be_written_is_named(tmp_path):
    with Journal(tmp_path / "deep" / "progress.jsonl", REQUEST, resume=True):
        assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    journal = Journal(tmp_path / "file" / "progress.jsonl", REQUEST, resume=False)
    with pytest.raises(OutputError, match=r"progress\.jsonl: cannot be written"):
        journal.add(0, [measured("a")])
