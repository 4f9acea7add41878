"""The precision of projection.  test_golden.py has the formulas, test_gsplat.py those of gsplat and of harmonics."""

import math
from dataclasses import replace

import pytest
import torch
from scipy.spatial.transform import Rotation

from aaplug import RULES_3DGS, Gaussians, Rules
from aaplug.core import shading
from aaplug.core.projection import project, with_ray_slopes
from aaplug.core.shading import shade
from tests.conftest import make_camera, make_scene, moved, straight_camera

F64 = torch.float64


@pytest.mark.parametrize("near", [0.01, RULES_3DGS.near, 2.0])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_what_lies_beyond_the_near_plane_is_drawn_and_the_plane_itself_is_not(dtype, near):
    scene = make_scene(5, dtype=dtype)
    depths = torch.tensor([near, 1.001 * near, -1.0, 0.0, 3.0], dtype=dtype)
    scene = replace(scene, means=torch.nn.functional.pad(depths[:, None], (2, 0)))
    splats = project(scene, straight_camera(), rules=Rules(near=near))
    assert splats.sources.tolist() == [1, 4]
    torch.testing.assert_close(splats.depths, depths[[1, 4]])
    torch.testing.assert_close(splats.opacities, scene.opacities[[1, 4]])


def needles(n: int, long: float, thin: float) -> Gaussians:
    """Needles of `long` × `thin` px, in random orientations but never end-on, near the axis of a straight camera."""
    g = torch.Generator().manual_seed(0)
    turn = torch.rand(n, generator=g, dtype=F64) * math.pi
    tilt = (torch.rand(n, generator=g, dtype=F64) - 0.5) * 2.0
    zero = torch.zeros(n, dtype=F64)
    about_z = torch.stack([(turn / 2).cos(), zero, zero, (turn / 2).sin()], dim=1)
    # a tilt about the needle's own y, then a turn about the optical axis: q = q_z · q_y
    cz, sz, cy, sy = about_z[:, 0], about_z[:, 3], (tilt / 2).cos(), (tilt / 2).sin()
    quats = torch.stack([cz * cy, -sz * sy, cz * sy, sz * cy], dim=1)
    means = torch.nn.functional.pad(torch.randn(n, 2, generator=g, dtype=F64), (0, 1), value=5.0)
    scales = torch.tensor([long, thin, thin], dtype=F64) * 5.0 / 100
    return Gaussians(means, quats, scales.log().expand(n, 3), zero, torch.zeros(n, 1, 3, dtype=F64))


@pytest.mark.parametrize(("long", "thin"), [(200.0, 0.1), (200.0, 0.01), (2000.0, 0.01)])
def test_the_determinant_of_a_needle_is_exact_in_float32(long, thin):
    scene, camera = needles(500, long, thin).to(torch.float32), straight_camera()
    single, exact = project(scene, camera), project(scene.to(F64), camera)
    from_covariance = single.covs[:, 0] * single.covs[:, 2] - single.covs[:, 1].square()
    lost = (from_covariance.double() / exact.dets - 1).abs()
    assert lost.median() > 1e-3, "the plain formula should fail for a needle this thin"
    error = (single.dets.double() / exact.dets - 1).abs()
    assert error.max() < 1e-5


def test_the_determinant_of_a_disc_seen_edge_on_is_not_negative():
    columns = {"means": [[0.0, 0.0, 2.0]], "quats": [[1.0, 0.0, 0.0, 0.0]], "log_scales": [[0.0, -46.0, 0.0]]}
    scene = replace(make_scene(1), **{name: torch.tensor(column) for name, column in columns.items()})
    splats = project(scene, straight_camera())
    assert splats.dets.item() >= 0
    assert splats.covs.isfinite().all()


def test_a_scene_far_from_the_origin_projects_as_if_it_were_near():
    offset = torch.tensor([2.0**22, -(2.0**22), 2.0**22], dtype=F64)
    scene, camera = make_scene(50, dtype=F64), make_camera((0.13, -4.07, 0.21))
    scene = replace(scene, means=scene.means.mul(2).round().div(2)).to(torch.float32)
    far = replace(scene, means=(scene.means.double() + offset).float())
    assert (far.means.double() - offset).equal(scene.means.double()), "halves are exact out there"
    away = moved(camera, offset)
    there, here = project(far, away), project(scene, camera)
    torch.testing.assert_close(there.means, here.means, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(there.covs, here.covs, rtol=1e-4, atol=1e-4)
    shaded = shade(there, far, away), shade(here, scene, camera)
    torch.testing.assert_close(shaded[0].rgb, shaded[1].rgb, rtol=1e-5, atol=1e-5)


def test_shading_in_chunks_gives_the_same_colours(monkeypatch):
    scene, camera = make_scene(50, degree=3), make_camera()
    splats, sh = project(scene, camera), scene.sh.clone().requires_grad_()
    whole = shade(splats, replace(scene, sh=sh), camera).rgb
    [gradient] = torch.autograd.grad(whole.square().sum(), [sh])
    monkeypatch.setattr(shading, "SPLATS_PER_CALL", 7)
    assert len(splats.sources) > 7
    parts = shade(splats, replace(scene, sh=sh), camera).rgb
    assert parts.equal(whole)
    assert torch.autograd.grad(parts.square().sum(), [sh])[0].equal(gradient)


def test_ray_slopes_are_those_of_the_mean_depth_behind_a_pixel():
    """Depth given the pixel, of the Gaussian of the linear projection's pixel and depth, from all its covariances."""
    scene, camera = make_scene(1, seed=3, dtype=F64), straight_camera()
    scene = replace(scene, means=torch.tensor([[0.3, -0.2, 4.0]], dtype=F64))
    x, y, z = scene.means[0].tolist()
    across, down = (camera.fx / z, 0, -camera.fx * x / z**2), (0, camera.fy / z, -camera.fy * y / z**2)
    both = torch.tensor([across, down, (0, 0, 1)], dtype=F64)
    axes = torch.from_numpy(Rotation.from_quat(scene.quats[0].roll(-1)).as_matrix()) * scene.scales[0]
    joint = both @ axes @ axes.T @ both.T
    joint[:2, :2] += 0.3 * torch.eye(2, dtype=F64)
    splats = with_ray_slopes(project(scene, camera).blurred(0.3, compensate=False), scene, camera)
    expected = torch.linalg.solve(joint[:2, :2], joint[:2, 2])
    assert expected.abs().min() > 1e-4
    torch.testing.assert_close(splats.ray_slopes[0], expected, rtol=1e-9, atol=0)
