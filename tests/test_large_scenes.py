"""What is done part by part is as with the whole: conversion, surveys, and harmonics that stay in a large file."""

import math
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from plyfile import PlyData

from aaplug import Gaussians, Renderer, TrainingViews, read_image, render
from aaplug.evaluation.coverage import Histogram, check_frame_of, survey
from aaplug.io.scenes import read_scene, write_parts, write_scene
from aaplug.io.scenes.scene import Scene, without_harmonics
from aaplug.methods.conversion import FORMS, fuse
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE
from aaplug.rendering import renderer as rendering
from aaplug.system.errors import FormatError, FrameError, UsageError
from aaplug.verbs.convert import convert_parts
from tests.conftest import SAMPLE, make_camera, make_scene, memory_taken, needs_peak_memory

VIEWS = (make_camera(), make_camera(eye=(0.3, -0.5, 0.2), name="inside"))
COUNT = 200_000  # Gaussians: 48 MB of .ply
A_GAUSSIAN = 150  # bytes: 11 numbers held, and once more while parts are joined
ONCE = 1.3 * 248 * COUNT  # bytes: the file's 62 numbers a Gaussian, and small parts
SLACK = 40 * 2**20  # bytes: parts at work


def written(folder: Path, count: int = 3000) -> tuple[Path, Gaussians]:
    """A scene in a file; some of its Gaussians have a filter to fuse."""
    scene = replace(make_scene(count, degree=3), filter_3d=torch.full((count,), 0.01))
    write_scene(folder / "scene.ply", scene)
    return folder / "scene.ply", scene


@pytest.fixture
def in_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Harmonics of any size stay in the file, and Gaussians are projected in chunks."""
    monkeypatch.setattr("aaplug.io.scenes.scene.MAX_HARMONICS_BYTES", 0)
    monkeypatch.setattr(rendering, "GAUSSIANS_AT_ONCE", 700)


def both(path: Path, recipe: str, drop_bad: bool = False) -> tuple[Renderer, Renderer]:
    """A renderer whose harmonics stay in the file, and one that holds them."""
    read, held = (read_scene(path, drop_bad=drop_bad) for _ in range(2))
    return Renderer.of(read, VIEWS, recipe), Renderer.of(held.gaussians(), VIEWS, recipe)


@pytest.mark.parametrize("recipe", ["classic", "auto", "mip-splatting"])
def test_images_are_the_same_to_the_bit(in_chunks, tmp_path: Path, recipe: str):
    read, held = both(written(tmp_path)[0], recipe)
    assert read.scene.sh.shape == held.scene.sh.shape
    assert read.scene.sh.isnan().all()
    for view in VIEWS:
        assert torch.equal(read(view).rgb, held(view).rgb)
        assert torch.equal(read.trained_at(2.0)(view).rgb, held.trained_at(2.0)(view).rgb)


def test_rows_that_are_left_out_shift_no_colours(in_chunks, tmp_path: Path):
    path, _ = written(tmp_path)
    spoiled = PlyData.read(path, mmap=False)
    spoiled["vertex"]["f_rest_21"][[0, 5, 1999]] = math.inf
    spoiled.write(path)
    with pytest.raises(FormatError, match=r"scene\.ply: row 0 \(and 2 more\) has Inf in f_rest_21"):
        without_harmonics(read_scene(path))
    read, held = both(path, "classic", drop_bad=True)
    assert torch.equal(torch.cat([read.harmonics(0, 1500), read.harmonics(1500, len(read.scene))]), held.scene.sh)
    assert torch.equal(read(VIEWS[0]).rgb, held(VIEWS[0]).rgb)


def test_a_file_that_changes_is_noticed(in_chunks, tmp_path: Path):
    path, scene = written(tmp_path)
    renderer = Renderer.of(path, VIEWS, "classic")
    write_scene(path, scene[:2000], overwrite=True)
    with pytest.raises(FormatError, match="changed while it was being read"):
        renderer(VIEWS[0])


def test_another_process_reads_the_file_itself(in_chunks, tmp_path: Path):
    renderer = Renderer.of(written(tmp_path)[0], VIEWS, "classic").portable()
    sent = pickle.dumps(renderer)
    assert len(sent) < A_GAUSSIAN * len(renderer.scene)
    assert torch.equal(pickle.loads(sent)(VIEWS[0]).rgb, renderer(VIEWS[0]).rgb)


def test_gaussians_that_were_read_anyway_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("aaplug.io.scenes.scene.MAX_HARMONICS_BYTES", 0)
    scene = read_scene(written(tmp_path)[0])
    assert without_harmonics(scene) is without_harmonics(scene), "it is read once"
    scene.gaussians()
    assert without_harmonics(scene) == (scene.gaussians(), None)


def test_the_command_draws_a_large_scene_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def images(folder: str) -> list[torch.Tensor]:
        chair, one = SAMPLE / "chair.ply", {"views": "r_8", "scale": 1 / 16, "threads": 1}
        return [read_image(file) for _, file in render(chair, SAMPLE, tmp_path / folder, **one)]

    expected = images("held")
    monkeypatch.setattr("aaplug.io.scenes.scene.MAX_HARMONICS_BYTES", 0)
    monkeypatch.setattr(Scene, "gaussians", lambda scene: pytest.fail("all of the scene is read"))
    assert all(torch.equal(a, b) for a, b in zip(images("read"), expected, strict=True))


MADE = """
from pathlib import Path
from aaplug.evaluation.laws.base import make_scene
from aaplug.io.scenes import ply, read_scene, scene, write_scene
from aaplug.io.scenes.scene import without_harmonics
scene.MAX_HARMONICS_BYTES = 0
ply.PART = 5_000
small = Path({path!r})
path = small.with_name("large.ply")
write_scene(path, make_scene({count}, degree=3))
"""


@needs_peak_memory
def test_memory_holds_a_scene_once_and_no_large_harmonics(tmp_path: Path):
    prepare = MADE.format(path=str(written(tmp_path)[0]), count=COUNT)
    works = "scene = without_harmonics(read_scene(path))", "scene = read_scene(path).gaussians()"
    without, whole = memory_taken(prepare, *works, warm="without_harmonics(read_scene(small))")
    assert without < SLACK + A_GAUSSIAN * COUNT
    assert whole < ONCE


SIZE = 37  # Gaussians a part, so that the last one is not full


def saved(folder: Path, scene: Gaussians) -> Path:
    write_scene(folder / "in.ply", scene)
    return folder / "in.ply"


@pytest.fixture
def wide_scene() -> Gaussians:
    """A scene of which cameras see only a part."""
    scene = make_scene(150)
    return replace(scene, means=scene.means * 4)


@pytest.mark.parametrize("form", FORMS)
def test_parts_are_converted_as_the_whole_is(tmp_path: Path, wide_scene, cameras, form: str):
    path = saved(tmp_path, wide_scene)
    scene = read_scene(path).gaussians()
    training = TrainingViews.of(scene, cameras)
    assert 0 < training.bounds.seen.sum() < len(scene)
    write_scene(tmp_path / "whole.ply", fuse(scene, training, FORMS[form]))
    opened, told = read_scene(path), []
    parts = convert_parts(opened, cameras, FORMS[form], tell=lambda *x: told.append(x), size=SIZE, threads=2)
    write_parts(tmp_path / "parts.ply", parts, opened.count)
    heads = [(tmp_path / n).read_bytes().split(b"end_header")[0] for n in ("parts.ply", "whole.ply")]
    assert heads[0] == heads[1]
    together, whole = (read_scene(tmp_path / name).gaussians() for name in ("parts.ply", "whole.ply"))
    for field in ("means", "log_scales", "logit_opacities", "sh"):  # products of matrices round by their size
        torch.testing.assert_close(getattr(together, field), getattr(whole, field), rtol=1e-5, atol=1e-6)
    assert (told[0], told[-1]) == ((0, 150), (150, 150))  # a rate counts from the first


def test_a_failure_in_a_late_part_leaves_no_file(tmp_path: Path, cameras):
    path = saved(tmp_path, make_scene(100))
    data = bytearray(path.read_bytes())
    stride = (len(data) - data.index(b"end_header\n") - 11) // 100
    at = len(data) - 10 * stride
    data[at : at + 4] = b"\xff\xff\xff\x7f"
    path.write_bytes(data)
    opened = read_scene(path)
    with pytest.raises(FormatError, match="row 90 has NaN in x"):
        write_parts(tmp_path / "out.ply", convert_parts(opened, cameras, FORMS["matched-energy"], size=SIZE), 100)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in.ply"]


def test_discs_are_converted_by_smoothing_alone(tmp_path: Path, cameras):
    path = saved(tmp_path, replace(make_scene(5), flat=True))
    with pytest.raises(UsageError, match="2D Gaussians"):
        list(convert_parts(read_scene(path), cameras, FORMS["matched-energy"]))
    [part] = convert_parts(read_scene(path), cameras, FORMS["mip-splatting"])
    assert part.flat


def test_strangers_are_noticed_on_a_sample(tmp_path: Path, cameras):
    path = saved(tmp_path, replace(make_scene(500), means=make_scene(500).means + 100))
    with pytest.raises(FrameError, match="different frames"):
        check_frame_of(read_scene(path), cameras, 0.5)
    near = tmp_path / "near.ply"
    write_scene(near, make_scene(500))
    assert check_frame_of(read_scene(near), cameras, 0.5) > 0.9


def test_a_survey_finds_what_the_whole_shows(tmp_path: Path, wide_scene, cameras):
    opened = read_scene(saved(tmp_path, wide_scene))
    found, scene = survey(opened, cameras), read_scene(opened.path).gaussians()
    bounds = TrainingViews.of(scene, cameras).bounds
    middle = scene.scales.median(dim=1).values
    under = middle[bounds.seen] < NYQUIST_VARIANCE**0.5 / bounds.highest[bounds.seen]
    assert (found.count, found.seen, found.under) == (150, bounds.seen.sum(), under.sum())
    assert torch.equal(found.low, scene.means.amin(0))
    assert found.rates.quantile(0.5) == pytest.approx(bounds.highest[bounds.seen].log().median().item(), abs=0.02)


def test_a_survey_counts_what_cannot_be_used(tmp_path: Path):
    scene = make_scene(20)
    path = saved(tmp_path, scene)
    data = bytearray(path.read_bytes())
    data[-4:] = b"\xff\xff\xff\x7f"  # the last row's last number
    path.write_bytes(data)
    told = []
    found = survey(read_scene(path), tell=lambda *x: told.append(x))
    assert (found.count, found.faults, told) == (19, {"NaN in rot_3": 1}, [(0, 20), (19, 20)])


def test_a_histogram_has_the_quantiles_of_its_values():
    values = torch.rand(10_000, generator=torch.Generator().manual_seed(0))
    histogram = Histogram(0.0, 1.0)
    assert histogram.quantile(0.5) is None
    for part in values.split(999):
        histogram.add(part)
    for share in (0.1, 0.5, 0.9):
        assert histogram.quantile(share) == pytest.approx(values.quantile(share).item(), abs=1e-3)
