"""Sampling bounds by hand, at the edges of what is seen, against loops; Gaussians against them; spectra of splats."""

import math
import statistics
from dataclasses import replace

import pytest
import torch

from aaplug import Camera, Renderer, TrainingViews
from aaplug.core.conventions import CLASSIC
from aaplug.core.sampling import check_frame, median_rates, rates_in_chunks, sampling_bounds
from aaplug.core.spectra import energies, frequency_response
from aaplug.evaluation.coverage import above_nyquist, coverage, log_multiples
from aaplug.lab.filters import view_information
from aaplug.methods.filters.smoothing import Smoothing3D
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.system.errors import FrameError, UsageError
from tests.conftest import make_camera, make_scene, memory_taken, moved, needs_peak_memory, splats_of, straight_camera

FAR = torch.tensor([5e6, -5e6, 5e6], dtype=torch.float64)
MEMORY_LIMIT = 35e6  # bytes


def ring() -> list[Camera]:
    """Cameras around the origin, each of another focal length; one with pixels that are not square."""
    eyes = [(4 * math.cos(a), 3 * math.sin(a), 1.5 * math.sin(3 * a)) for a in range(7)]
    cameras = [make_camera(eye, fov=0.4 + 0.2 * (i % 4)) for i, eye in enumerate(eyes)]
    return [replace(cameras[0], fy=cameras[0].fy * 1.3), *cameras[1:]]


def rates_by_loop(mean: list[float], cameras: list[Camera]) -> list[float]:
    """Sampling rates of the cameras that see a point, in plain Python floats."""
    rates = []
    for camera in cameras:
        pose = camera.cam_from_world.tolist()
        x, y, z = (sum(row[j] * mean[j] for j in range(3)) + row[3] for row in pose[:3])
        if z <= 0.2:
            continue
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (-0.15 * s <= place <= 1.15 * s for place, s in ((u, camera.width), (v, camera.height)))
        if all(inside):
            rates.append(math.sqrt(camera.fx * camera.fy) / z)
    return rates


@pytest.mark.parametrize("centre", [(40.0, 20.0), (16.0, 32.0)], ids=["centred", "off centre"])
def test_the_image_counts_with_a_margin_of_15_percent(centre):
    """15 % of 80 px are 12 px, of 40 px 6 px; binary numbers hold both exactly."""
    edges = [[92.0, 20.0], [-12.0, 20.0], [40.0, 46.0], [40.0, -6.0]]
    outside = [[92.01, 20.0], [-12.01, 20.0], [40.0, 46.01], [40.0, -6.01]]
    slopes = (torch.tensor(edges + outside, dtype=torch.float64) - torch.tensor(centre)) / 64.0
    points = torch.nn.functional.pad(slopes, (0, 1), value=1.0)
    seen = sampling_bounds(points, [straight_camera(64.0, (80, 40), centre)]).seen
    assert seen.tolist() == [True] * 4 + [False] * 4


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_near_plane_itself_is_not_seen(dtype):
    depths = torch.tensor([-1.0, 0.0, 0.1999, 0.2, 0.2001], dtype=dtype)
    points = torch.nn.functional.pad(depths[:, None], (2, 0))
    seen = sampling_bounds(points, [straight_camera()]).seen
    assert seen.tolist() == [False, False, False, False, True]


def test_unseen_gaussians_have_rate_zero_or_by_choice_the_coarsest():
    points = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, 8.0], [0.0, 0.0, -1.0], [99.0, 0.0, 1.0]])
    bounds = sampling_bounds(points, [straight_camera(64.0)])
    assert bounds.seen.tolist() == [True, True, False, False]
    assert bounds.highest.tolist() == [32.0, 8.0, 0.0, 0.0]
    assert bounds.lowest.tolist() == [32.0, 8.0, 0.0, 0.0]
    assert bounds.views.tolist() == [1, 1, 0, 0]
    assert bounds.highest_or_coarsest.tolist() == [32.0, 8.0, 8.0, 8.0]
    assert median_rates(points, [straight_camera(64.0)]).tolist() == [32.0, 8.0, 0.0, 0.0]


def test_a_scene_that_no_camera_sees_is_no_crash_of_a_library():
    scene = make_scene(3)
    training = TrainingViews.of(scene, [straight_camera(back=-1e3)])
    assert not training.bounds.seen.any()
    with pytest.raises(FrameError, match="no camera sees any Gaussian"):
        Smoothing3D()(scene, training)


@pytest.mark.parametrize(
    ("dtype", "offset", "rtol"), [(torch.float64, 0.0, 1e-12), (torch.float32, 0.0, 2e-6), (torch.float32, 1.0, 2e-6)]
)
def test_bounds_agree_with_a_loop_in_float64_also_far_from_the_origin(dtype, offset, rtol):
    means = (make_scene(200, seed=3).means.double() * 3 + offset * FAR).to(dtype)  # rounded to half units out there
    cameras = [moved(camera, offset * FAR) for camera in ring()]
    bounds, median = sampling_bounds(means, cameras), median_rates(means, cameras)
    expected = [rates_by_loop(mean, cameras) for mean in means.tolist()]
    counts = [len(rates) for rates in expected]
    assert len(set(counts)) == len(cameras) + 1, "the scene should try every number of views"
    assert bounds.views.tolist() == counts
    for got, pick in ((bounds.highest, max), (bounds.lowest, min), (median, statistics.median_low)):
        want = torch.tensor([pick(rates) if rates else 0.0 for rates in expected], dtype=dtype)
        torch.testing.assert_close(got, want, rtol=rtol, atol=0)


def information_by_loop(mean: torch.Tensor, cameras: list[Camera]) -> torch.Tensor:
    """View information at a point, in float64: I - d dᵀ of the rays d of the cameras that see it, by their rates."""
    rates = [max(rates_by_loop(mean.tolist(), [camera]), default=0.0) for camera in cameras]
    rays = [torch.nn.functional.normalize(mean.double() - camera.centre, dim=0) for camera in cameras]
    eye = torch.eye(3, dtype=torch.float64)
    return sum(rate**2 * (eye - ray.outer(ray)) for rate, ray in zip(rates, rays, strict=True))


@pytest.mark.parametrize(
    ("dtype", "offset", "tolerance"),
    [(torch.float64, 0.0, 1e-12), (torch.float32, 0.0, 1e-6), (torch.float64, 1.0, 1e-8)],
    ids=["float64", "float32", "far from the origin"],
)
def test_view_information_agrees_with_a_loop_in_float64(dtype, offset, tolerance, monkeypatch):
    monkeypatch.setattr("aaplug.core.sampling.CHUNK_PAIRS", 20)
    cameras = [moved(camera, offset * FAR) for camera in ring()]
    means = make_scene(30, dtype=torch.float64).means
    means[3] = torch.tensor([0.0, 0.0, 500.0])
    means = (means + offset * FAR).to(dtype)
    information = view_information(means, cameras)
    expected = torch.stack([information_by_loop(mean, cameras) for mean in means])
    assert information.dtype == dtype
    assert (sampling_bounds(means, cameras).seen == (expected.abs().amax(dim=(1, 2)) > 0)).all()
    torch.testing.assert_close(information.double(), expected, rtol=0, atol=tolerance * expected.abs().max().item())


@pytest.mark.parametrize("chunk_pairs", [1, 7, 64, 349, 10**9])
@pytest.mark.parametrize("box", [3, 1024])
def test_the_size_of_chunks_changes_nothing(chunk_pairs, box, monkeypatch):
    means, cameras = make_scene(50).means * 2, ring()
    whole = sampling_bounds(means, cameras)
    monkeypatch.setattr("aaplug.core.sampling.CHUNK_PAIRS", chunk_pairs)
    monkeypatch.setattr("aaplug.core.sampling.BOX", box)
    parts = sampling_bounds(means, cameras)
    torch.testing.assert_close(parts.highest, whole.highest, rtol=1e-6, atol=0)
    torch.testing.assert_close(parts.lowest, whole.lowest, rtol=1e-6, atol=0)
    assert parts.views.equal(whole.views)


@pytest.mark.parametrize("offset", [0.0, 1.0], ids=["at the origin", "far from it"])
def test_of_many_cameras_only_those_that_may_see_a_part_of_the_scene_are_compared_with_it(offset, monkeypatch):
    """A camera every 10 units of a street, in any order, each of which sees a few units of it."""
    means = torch.rand(2000, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 2 - 1
    means[:, 0] *= 500
    cameras = [moved(make_camera((0.0, -4.0, 0.0)), (x, 0.0, 0.0)) for x in range(-500, 501, 10)]
    means, cameras = (means + offset * FAR).float(), [moved(camera, offset * FAR) for camera in cameras]
    whole = sampling_bounds(means, cameras)
    monkeypatch.setattr("aaplug.core.sampling.CHUNK_PAIRS", 10_000)
    monkeypatch.setattr("aaplug.core.sampling.BOX", 20)
    parts = sampling_bounds(means, cameras)
    assert 500 < whole.seen.sum() < 2000
    assert all(map(torch.equal, vars(parts).values(), vars(whole).values()))
    pairs = sum(rates.numel() for *_, rates in rates_in_chunks(means, cameras))
    assert pairs < len(means) * len(cameras) / 10


@pytest.mark.parametrize("find", [sampling_bounds, median_rates, view_information])
def test_at_least_one_camera_is_needed(find):
    with pytest.raises(UsageError, match="at least one"):
        find(torch.zeros(1, 3), [])


def test_the_frame_check_returns_the_share_of_gaussians_seen_and_all_of_none():
    points = torch.tensor([[0.0, 0.0, 1.0]] * 3 + [[0.0, 0.0, -1.0]])
    assert check_frame(points, [straight_camera()], "scene.ply") == 0.75
    assert check_frame(points[:0], [straight_camera()], "empty") == 1.0
    many = torch.zeros(200_000, 3)  # of which a sample is looked at
    many[:, 2] = torch.where(torch.arange(200_000) < 120_000, 1.0, -1.0)
    assert check_frame(many, [straight_camera()], "large") == pytest.approx(0.6, abs=0.01)


def test_cameras_of_another_scene_are_refused():
    means = make_scene(500).means
    strangers = [moved(camera, (0.0, 0.0, 200.0)) for camera in ring()]
    assert check_frame(means, ring(), "garden.ply") > 0.9
    with pytest.raises(FrameError, match=r"garden\.ply: only .*% .*different frames") as caught:
        check_frame(means, strangers, "garden.ply")
    assert caught.value.where == "garden.ply"
    assert "7 cameras" in caught.value.problem
    assert "dataparser_transforms.json" in caught.value.problem
    assert "nothing nearer than 0.2 units" in caught.value.problem
    assert check_frame(means, strangers, "garden.ply", min_share=0.0) < 0.5


BOUNDS = """
from aaplug.core import sampling
from aaplug.core.sampling import sampling_bounds
from aaplug.evaluation.laws.base import make_camera
means, cameras = torch.randn(100_000, 3), [make_camera((0.0, -4.0 - i / 50, 0.0)) for i in range(60)]
sampling.CHUNK_PAIRS //= 10
sampling_bounds(means[:100], cameras)
"""


@needs_peak_memory
def test_memory_does_not_grow_with_gaussians_times_cameras():
    [taken] = memory_taken(BOUNDS, "sampling_bounds(means, cameras)")
    assert taken < MEMORY_LIMIT


def at_bound(multiple: float):
    """Ten round Gaussians at the origin whose extent is that multiple of their bound."""
    view = make_camera((0.0, -4.0, 0.0))
    sigma = multiple * 0.2**0.5 / (view.focal / 4.0)
    scene = replace(make_scene(10), means=torch.zeros(10, 3), log_scales=torch.full((10, 3), sigma).log())
    return scene, TrainingViews.of(scene, [view])


@pytest.mark.parametrize("multiple", [0.5, 1.01, 3.0])
def test_the_multiple_is_the_extent_over_the_bound(multiple):
    scene, training = at_bound(multiple)
    found = log_multiples(scene, training.bounds).exp()
    assert found == pytest.approx([multiple] * 10, rel=1e-4)
    assert coverage(scene, training, ()).under == (multiple < 1)


def test_aliasing_begins_where_what_training_drew_meets_the_bound():
    scene, training = at_bound(2.0)
    assert scene.convention == CLASSIC
    found = coverage(scene, training, (1.0, 0.5, 0.4, 0.25))
    # σ²ν² = 4·0.2 px², and 0.3 px² of dilation: r²·1.1 = 0.2
    assert found.begins == pytest.approx((0.2 / 1.1) ** 0.5, rel=1e-4)
    assert dict(found.aliased) == {1.0: 0.0, 0.5: 0.0, 0.4: 1.0, 0.25: 1.0}


@pytest.mark.parametrize(("shift", "seen"), [(0.0, True), (1e6, False)])
def test_every_seen_gaussian_is_in_the_histogram(shift, seen):
    scene = make_scene(400)
    scene = replace(scene, means=scene.means + shift, log_scales=scene.log_scales * 6)  # far into both ends
    training = TrainingViews.of(scene, [make_camera()])
    found = coverage(scene, training, (1.0,))
    assert sum(found.counts) == found.seen == int(training.bounds.seen.sum())
    assert (found.gaussians, found.seen > 0) == (400, seen)
    if not seen:
        assert (found.under, found.begins, found.aliased) == (None, None, ())


F64 = torch.float64
STEP, SIDE = 0.1, 200  # px; of a grid that holds both splats whole
ROWS = ((0.7, (0.3, 0.1, 0.2)), (0.4, (4.0, -1.5, 1.0)))
SPLATS = splats_of(*(((0.0, 0.0), cov, 1.0, opacity, (1.0, 1.0, 1.0)) for opacity, cov in ROWS))
LINE = (torch.arange(SIDE, dtype=F64) - SIDE / 2) * STEP
GRID = torch.cartesian_prod(LINE, LINE)
ALPHA = (SPLATS.opacities * POINT.exact(SPLATS, GRID[:, None].expand(-1, 2, -1))).T


def test_the_response_is_the_fourier_transform_of_alpha():
    omega = torch.tensor([[0.0, 0.0], [1.0, 0.5], [-2.0, 3.0], [math.pi, 0.0]], dtype=F64)
    expected = ALPHA @ (GRID @ omega.T).cos() * STEP**2
    torch.testing.assert_close(frequency_response(SPLATS, omega), expected, rtol=1e-6, atol=1e-5)


def test_the_share_above_nyquist_is_that_of_the_squared_response_outside_the_band():
    step = math.pi / 50
    line = (torch.arange(-250, 250, dtype=F64) + 0.5) * step
    omega = torch.cartesian_prod(line, line)
    for i, (xx, xy, yy) in enumerate(SPLATS.covs.tolist()):
        squared = frequency_response(SPLATS, omega)[i].square()
        angle = 0.5 * math.atan2(2 * xy, xx - yy)
        axes = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]], dtype=F64)
        outside = ((omega @ axes.T).abs() > math.pi).any(dim=1)
        share = squared[outside].sum() / squared.sum()
        assert energies(SPLATS)[1][i].item() == pytest.approx(share.item(), abs=2e-3)
        assert squared.sum() * step**2 / (4 * math.pi**2) == pytest.approx(energies(SPLATS)[0][i].item(), rel=1e-6)


def test_smaller_images_have_more_energy_above_nyquist_unless_samples_keep_up():
    scene, view = make_scene(60), make_camera()
    found = {name: Renderer.of(scene, [view], name) for name in ("matched", "auto", "analytic")}
    shares = {name: [above_nyquist(r, [view], s) for s in (1.0, 0.25, 0.125)] for name, r in found.items()}
    assert 0 < shares["matched"][0] < shares["matched"][1] < shares["matched"][2] < 1
    assert shares["auto"][2] < shares["matched"][2]
    assert shares["analytic"] == [None] * 3
    assert above_nyquist(replace(found["matched"], scene=scene[:0]), [view], 1.0) is None
