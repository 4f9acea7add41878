"""What is done part by part is what would be done with the whole."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from aaplug import Gaussians, TrainingViews
from aaplug.evaluation.coverage import Histogram, check_frame_of, survey
from aaplug.io.scenes import read_scene, write_parts, write_scene
from aaplug.methods.conversion import FORMS, fuse
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE
from aaplug.system.errors import FormatError, FrameError, OutputError, UsageError
from aaplug.verbs.convert import convert_parts
from tests.conftest import make_scene

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
    scene = make_scene(100)
    scene.means[90, 1] = math.nan
    path = tmp_path / "in.ply"
    with pytest.raises(OutputError, match="row 90 has NaN in y"):
        write_scene(path, scene)
    assert not path.exists()
    write_scene(path, make_scene(100))
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
