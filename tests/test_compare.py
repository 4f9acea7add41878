"""Scenes held to the first of them: what is equal, what differs, what is refused, and what is written."""

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest
import torch

import aaplug
from aaplug import read_cameras, read_scene, write_scene
from aaplug.core.conventions import MIP
from aaplug.evaluation.alignment import mismatch
from aaplug.evaluation.comparison import differences
from aaplug.evaluation.engine import ViewMeasurer
from aaplug.evaluation.journal import Journal
from aaplug.evaluation.report.contact_sheet import ERROR_FULL, HEAT, contact_sheet, error_map, side_by_side
from aaplug.io.images import image_size
from aaplug.system.executors import load, save
from tests.conftest import EYES, make_scene, shuffled
from tests.scene_files import DATA, half_turn_about_x
from tests.test_batch import killed_at

WORDS = "--cameras . --rasterizer eager --views train --scale 0.5 1 2"
QUICK = "--cameras . --rasterizer eager --scale 0.5 --metric psnr"
TURNS = {
    "turned by 180 degrees about x": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "turned by -90 degrees about z": [[0, 1, 0], [-1, 0, 0], [0, 0, 1]],
    "mirrored along y": [[1, 0, 0], [0, -1, 0], [0, 0, 1]],
    "turned by 120 degrees about (0.58, 0.58, 0.58)": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
}


@pytest.fixture(scope="module")
def lopsided():
    """A scene that no turn carries onto itself."""
    scene = make_scene(2000, seed=3)
    ball = torch.nn.functional.normalize(scene.means, dim=1)
    return replace(scene, means=ball * torch.tensor([1.0, 1.6, 0.6]) + ball.square() * torch.tensor([0.4, 0.3, 0.2]))


def carried(scene, turn, scale=1.0, shift=(0.0, 0.0, 0.0)):
    means = scale * scene.means @ torch.tensor(turn, dtype=torch.float32).T + torch.tensor(shift)
    return replace(scene, means=means)


def test_a_scene_equals_itself_at_every_scale(cli):
    found = cli.facts(f"compare scene.ply scene.ply {WORDS} --fail-under 200dB")
    assert found["guard"]["value"] is None
    first, again = (found["scenes"][name] for name in ("0_scene.ply", "1_scene.ply"))
    assert again["differences"]["positions"] == {"rms": 0, "median": 0, "largest": 0}
    for scale in ("0.5", "1", "2"):
        figures = again["scales"][scale]
        assert figures["PSNR"] is None
        assert figures["equal_views"] == len(EYES["train"])
        assert figures["SSIM"]["mean"] == pytest.approx(1.0)
        assert list(figures["per_view"]) == ["r_0", "r_1", "r_2"]
    assert again["scales"]["0.5"]["flicker"]["mean"] == 1.0
    assert first["scales"]["1"]["PSNR"] is None
    _, out, _ = cli(f"compare scene.ply scene.ply {WORDS} --metric psnr")
    assert out.count("∞") == 6


def test_tables_break_no_word_at_80_columns(cli, monkeypatch):
    names = ["a_scene_whose_name_is_long.ply", "another_whose_name_is_long.ply", "a_third_of_a_length_like_that.ply"]
    for name in names:
        write_scene(name, make_scene(20))
    out = cli(f"compare {' '.join(names)} {QUICK} --min-seen 0")[1].split()
    assert [out.count(name) for name in names] == [4, 5, 5]  # the facts, a metric, and two of cost; differences
    for verb in ("viewers", "recipes"):
        narrow = cli(verb)[1]
        with monkeypatch.context() as patch:
            patch.setenv("COLUMNS", "1000")
            assert set(narrow.split()) == set(cli(verb)[1].split())


def test_what_a_change_costs_is_measured_and_guarded(cli):
    scene = read_scene("scene.ply").gaussians()
    write_scene("dim.ply", replace(scene, logit_opacities=scene.logit_opacities - 0.3))
    write_scene("grey.splat", scene)
    words = f"compare scene.ply dim.ply grey.splat {WORDS} --metric psnr --fail-under"
    code, out, err = cli(f"{words} 60dB --json")
    found = json.loads(out)
    lowest = found["guard"]
    means = {
        (name, float(scale)): figures["PSNR"]["mean"]
        for name in ("dim.ply", "grey.splat")
        for scale, figures in found["scenes"][name]["scales"].items()
    }
    assert (lowest["scene"], lowest["scale"]) == min(means, key=lambda key: means[key])
    assert lowest["value"] == min(means.values()) < 60
    assert code == 1
    assert f"{lowest['scene']} at {lowest['scale']:g}: mean PSNR {lowest['value']:.2f} dB is below 60 dB" in err
    figures = found["scenes"]["dim.ply"]["scales"]["1"]["PSNR"]
    values = [view["PSNR"] for view in found["scenes"]["dim.ply"]["scales"]["1"]["per_view"].values()]
    assert figures["worst"]["value"] == min(values)
    assert figures["mean"] == pytest.approx(sum(values) / 3)
    assert figures["median"] == sorted(values)[1]
    assert found["scenes"]["dim.ply"]["differences"]["opacities"]["largest"] > 0.05
    assert found["scenes"]["dim.ply"]["differences"]["SH 0"]["rms"] == 0
    assert found["scenes"]["grey.splat"]["bytes"] == Path("grey.splat").stat().st_size
    lost = f"has SH degree 0, scene.ply {scene.sh_degree}: what one lacks counts as a difference from 0"
    assert f"grey.splat: {lost}" in cli.done(f"{words} {min(means.values()) - 0.01}")[1]


def test_the_truth_is_the_reference_at_that_size(cli):
    scene, cameras = read_scene("scene.ply").gaussians(), read_cameras(".")
    dim = replace(scene, logit_opacities=scene.logit_opacities - 0.3)
    found = aaplug.compare({"a": scene, "b": dim}, cameras, scale=(0.5,), metric="psnr", rasterizer="eager")
    a, b = (
        aaplug.Renderer.of(s, cameras, rasterizer="eager")(cameras.test[0].scaled(0.5)).rgb.clamp(0, 1).mul(255).round()
        for s in (scene, dim)
    )
    expected = -10 * math.log10(float(((a - b) / 255).double().square().mean()))
    assert found.lowest == (pytest.approx(expected, abs=1e-4), "b", 0.5)


def test_a_viewer_draws_all_and_the_truth_stays(cli):
    words = f"compare scene.ply scene.ply {WORDS} --metric psnr"
    shown = cli.facts(f"{words} --for classic")["scenes"]["0_scene.ply"]
    found = cli.facts(f"{words} --for mip")
    (first, second), guard = found["scenes"].values(), found["guard"]
    assert shown["scales"]["1"]["PSNR"] is None  # as training did
    assert shown["scales"]["0.5"]["PSNR"]["mean"] < 60
    assert first["scales"]["1"]["PSNR"]["mean"] == second["scales"]["1"]["PSNR"]["mean"] < 60
    assert (guard["scene"], guard["value"] < 60) == ("1_scene.ply", True)  # the first is the yardstick
    code, _, err = cli(f"{words} --for mip --recipe classic")
    assert (code, "--for" in err or "--viewer" in err) == (2, True)


def test_another_reference_and_levels_of_detail(cli):
    cli.done("lod scene.ply --cameras . -o levels --levels 1 --no-refine --rasterizer eager")
    found = cli.facts(f"compare levels scene.ply --reference scene.ply {QUICK}")
    assert found["reference"] == "scene.ply"
    assert list(found["scenes"]) == ["scene.ply", "levels"]
    assert found["scenes"]["levels"]["format"] == "levels"
    assert found["scenes"]["levels"]["bytes"] == sum(file.stat().st_size for file in Path("levels").iterdir())


def test_differences_are_found_in_any_order(lopsided):
    moved = replace(lopsided, means=lopsided.means + torch.tensor([1e-4, 0.0, 0.0]), sh=lopsided.sh * 1.0)
    moved.sh[:, 1:4] += 0.01
    for other in (moved, shuffled(moved)):
        found = differences(lopsided, other)
        assert found.sorted == (other is not moved)
        assert found.paired == 1
        assert found.changes["positions"].median == pytest.approx(1e-4, rel=1e-2)
        assert all(found.changes[name].largest == 0 for name in ("scales", "opacities", "SH 0"))
        assert found.changes["SH 1"].rms == pytest.approx(0.01, rel=1e-3)
    plain = replace(lopsided, sh=lopsided.sh[:, :1])
    lost = differences(lopsided, plain).changes["SH 1"]
    assert lost.largest == pytest.approx(float(lopsided.sh[:, 1:4].abs().max()))
    assert differences(lopsided, lopsided[:-1]) is None


@pytest.mark.parametrize("words", TURNS)
@pytest.mark.parametrize("order", ["rows", "sorted", "pruned"])
def test_a_turn_is_named(lopsided, words, order):
    other = carried(lopsided, TURNS[words])
    other = {"rows": other, "sorted": shuffled(other), "pruned": shuffled(other)[:1500]}[order]
    assert mismatch(lopsided, other) == words


def test_a_scale_a_shift_and_any_turn_are_named(lopsided):
    identity, cos, sin = torch.eye(3).tolist(), math.cos(0.5), math.sin(0.5)
    assert mismatch(lopsided, shuffled(carried(lopsided, identity, 2.0))) == "scaled by 2"
    assert mismatch(lopsided, shuffled(carried(lopsided, identity, 1.0, (0, 3, 0)))) == "moved by (0, 3, 0)"
    odd = [[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]]
    both = "turned by 28.6 degrees about y, scaled by 1.5"
    assert mismatch(lopsided, carried(lopsided, odd, 1.5)) == both
    assert mismatch(lopsided, shuffled(carried(lopsided, odd, 1.5))).startswith(both)


def test_scenes_in_one_frame_are_not_taken_for_turned(lopsided):
    noise = torch.randn(len(lopsided), 3, generator=torch.Generator().manual_seed(1))
    rough = replace(lopsided, means=lopsided.means + 0.02 * noise)
    for other in (lopsided, shuffled(lopsided), lopsided[:50], rough, shuffled(rough), lopsided[:0]):
        assert mismatch(lopsided, other) is None
    turned = carried(lopsided, [[1, -1e-4, 0], [1e-4, 1, 0], [0, 0, 1]])  # too little to name; it moves a far origin
    assert mismatch(*(replace(scene, means=scene.means + 3e3) for scene in (lopsided, turned))) is None
    line = replace(lopsided[:50], means=torch.linspace(-1, 1, 50)[:, None] * torch.ones(3) + 900)
    assert mismatch(lopsided, line).startswith("elsewhere: half of its Gaussians lie 1")


def test_other_frames_are_refused_by_name(cli):
    write_scene("turned.ply", half_turn_about_x(read_scene("scene.ply").gaussians()))
    named = "turned.ply: is scene.ply turned by 180 degrees about x"
    Path("broken.ply").write_bytes(Path("scene.ply").read_bytes()[:-100])
    cli.refused(f"compare scene.ply broken.ply {QUICK}", "broken.ply: ")
    cli.refused(f"compare scene.ply turned.ply {QUICK}", f"{named}; bring both into one frame, or pass --any-frame")
    out, err = cli.done(f"compare scene.ply turned.ply {QUICK} --any-frame --json")
    assert json.loads(out)["scenes"]["turned.ply"]["frame"] == "turned by 180 degrees about x"
    assert f"warning: {named}" in err


@pytest.mark.parametrize("axes", ["opengl", "opencv"])
def test_a_spz_is_read_in_the_frame_of_the_other(cli, axes):
    scene = read_scene("scene.ply").gaussians()
    write_scene("c.spz", scene, spz_axes=axes, spz_version=3)
    for words in ("scene.ply c.spz", "c.spz scene.ply"):
        assert "as fits scene.ply" in cli.done(f"compare {words} {QUICK}")[1]


@pytest.fixture
def texts(monkeypatch):
    """What is written into pictures, in order."""
    texts = []
    monkeypatch.setattr("cv2.putText", lambda sheet, text, *rest: texts.append(text))
    return texts


def test_files_and_a_continued_run(cli, monkeypatch, plots_drawn_once, texts):
    scene = read_scene("scene.ply").gaussians()
    write_scene("dim.ply", replace(scene, logit_opacities=scene.logit_opacities - 1))
    write_scene("same.ply", scene)
    words = f"compare scene.ply dim.ply same.ply {WORDS} -o out --show 1 --metric psnr"
    with monkeypatch.context() as patch:
        patch.setattr(Journal, "add", killed_at(2))
        assert cli(words)[0] == 130
    assert "resume" in cli(words)[2]
    cli.done(f"{words} --resume")
    data = json.loads(Path("out/compare.json").read_text())
    per_view = [scale["per_view"] for scale in data["scenes"]["dim.ply"]["scales"].values()]
    _, worst = min((views[name]["PSNR"], name) for views in per_view for name in views)
    captions = [f"{views[worst]['PSNR']:.2f} dB" for views in reversed(per_view)]
    assert [text for text in texts if "dB" in text] == captions
    assert cli.facts(f"{words} --overwrite")["guard"] == data["guard"]
    rows = list(csv.DictReader(Path("out/compare.csv").read_text().splitlines()))
    assert len(rows) == 3 * 3 * 3  # scenes, scales, views
    names = ("scene.ply", "dim.ply", "same.ply")
    assert {(row["scene"], row["compared scene"]) for row in rows} == {("scene.ply", name) for name in names}
    page = Path("out/report.html").read_text()
    said = ("aaplug comparison", "against the first scene", "differences of the Gaussians", "compared scene")
    assert [words for words in said if words not in page] == []
    assert re.search(r"<b>same.ply</b> reaches <b>∞ dB</b>, dim.ply \d+\.\d\d dB", page)
    width, height = image_size(Path("out/contact-sheet.png"))
    assert width > height > 3 * 320


def test_pictures_hold_no_sign_that_the_font_lacks(texts):
    image = torch.zeros(400, 400, 3)
    side_by_side([image, image], ["4× – é ∞ 日", "½×"], 0.1, 0.25)
    contact_sheet(("a×", "b×"), [(2.0, (image, image))])
    enlarged = "0.25 of training's sampling, 9x"
    assert texts == [enlarged, "4x - e inf ?", enlarged, "1?2x", "ax", "bx", "2x: 400x400", "equal"]


def test_under_each_picture_stands_its_psnr_against_the_first_of_its_row(texts):
    images = [torch.full((5, 6, 3), level / 255) for level in (100, 100, 110)]
    contact_sheet(("truth", "same", f"a{'x' * 99}z"), [(0.5, images), (0.25, images)], errors=True)
    assert (texts[:3], texts[4]) == (["truth", "same", "error"], "error")
    assert re.fullmatch(r"ax{9,}\.\.\.x{9,}z", texts[3]), "no wider than its picture"
    assert cv2.getTextSize(texts[3], cv2.FONT_HERSHEY_SIMPLEX, 0.6, 1)[0][0] <= 6 / 5 * 320
    assert texts[5:] == ["1/2: 6x5", "equal", "28.13 dB", "1/4: 6x5", "equal", "28.13 dB"]


def test_an_error_map_runs_from_black_to_the_end_of_the_scale():
    truth = torch.zeros(1, 3, 3)
    image = truth.clone()
    image[0, 1, 2], image[0, 2, 0] = ERROR_FULL / 255, 1.0
    expected = torch.tensor([HEAT[0], HEAT[-1], HEAT[-1]], dtype=torch.float32)
    torch.testing.assert_close(error_map(image, truth)[0] * 255, expected)


def test_views_measured_in_processes_are_the_same(cli, monkeypatch, tmp_path):
    """What goes to them comes back from a file, as in each of them."""

    def sent(work, items):
        save(work, tmp_path / "work.pt")
        return map(load(str(tmp_path / "work.pt")), items)

    scene, cameras = read_scene("scene.ply").gaussians(), read_cameras(".")
    given = {"a": scene, "b": replace(scene, convention=MIP)}
    how = {"scale": (0.5,), "rasterizer": "eager", "threads": 2, "views": "train", "metric": "psnr"}
    expected = aaplug.compare(given, cameras, **how).report
    monkeypatch.setattr("aaplug.rendering.job.ProcessesIfLong", lambda threads: SimpleNamespace(map=sent))
    found = aaplug.compare(given, cameras, **how).report
    assert [m.values for m in found.measurements] == [m.values for m in expected.measurements]


def test_what_goes_to_another_process_leaves_files_behind(cli, monkeypatch):
    seen = []
    monkeypatch.setattr(ViewMeasurer, "__call__", lambda self, index: (seen.append(self.__getstate__()["task"]), 0 / 0))
    with pytest.raises(ZeroDivisionError):
        aaplug.compare(["scene.ply", "scene.ply"], ".", rasterizer="eager")
    (task,) = seen
    assert all(renderer.scene.origin is None for renderer in task.renderers.values())
    first, truth = (renderer.scene.columns for renderer in (next(iter(task.renderers.values())), task.truth.renderer))
    assert all(column is truth[name] for name, column in first.items()), "sent once"


def test_bytes_of_a_folder_of_images_are_those_of_all():
    folder = DATA / "oracle_sog"
    scene = read_scene(folder / "meta.json")
    assert scene.bytes == sum(file.stat().st_size for file in folder.iterdir())
    assert replace(scene, others=()).bytes == (folder / "meta.json").stat().st_size
    assert replace(scene, path=folder / "gone.ply").bytes is None
