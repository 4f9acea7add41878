"""What single filters promise beyond the laws that all of them keep."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug.filters import Adaptive, Smoothing3D
from aaplug.filters.adaptive import ADAPTIVE_VARIANCE
from aaplug.filters.smoothing import BALANCE_FLOOR
from aaplug.pipeline import learn
from aaplug.projection import project, rotation_matrices
from tests.conftest import make_camera, make_scene

F64 = torch.float64
WIDE = make_scene(60, dtype=F64)
SCENE = replace(WIDE, means=0.2 * WIDE.means)  # every camera sees all of it
NEAR, FAR = make_camera((0.0, -4.0, 0.0)), make_camera((3.0, -6.0, 1.0))
LONG = replace(FAR, fx=2 * FAR.fx, fy=2 * FAR.fy)


def widened_in_the_world(scene, training, camera):
    """AAA-Gaussians as the paper has it: a variance in the world, of each Gaussian in this view."""
    depths = project(scene, camera).depths
    here = ADAPTIVE_VARIANCE * (depths / camera.focal) ** 2
    added = torch.maximum(ADAPTIVE_VARIANCE / training.bounds.highest**2, here)
    return replace(scene, log_scales=0.5 * (scene.scales**2 + added[:, None]).log())


@pytest.mark.parametrize("scale", [0.2, 1.0, 3.0])
def test_the_adaptive_filter_is_a_variance_in_the_world(scale):
    training, camera = learn(SCENE, [NEAR, FAR]), NEAR.scaled(scale)
    raw = project(SCENE, camera)
    assert len(raw) == len(SCENE), "the test needs all of them"
    assert training.bounds.seen.all()
    wide = project(widened_in_the_world(SCENE, training, camera), camera)
    filtered = Adaptive()(raw, camera, training)
    torch.testing.assert_close(filtered.covs, wide.covs, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(filtered.dets, wide.dets, rtol=1e-6, atol=1e-9)


def test_the_adaptive_filters_factor_is_the_change_of_area_across_the_ray():
    """The published form: r · (s_y² s_z², s_z² s_x², s_x² s_y²), r the squared direction in the Gaussian's axes."""
    training = learn(SCENE, [NEAR, FAR])
    wide = widened_in_the_world(SCENE, training, NEAR)
    rotations = rotation_matrices(SCENE.unit_quats)
    towards = SCENE.means - NEAR.centre
    towards = towards / towards.norm(dim=1, keepdim=True)
    shares = torch.einsum("nij,ni->nj", rotations, towards) ** 2

    def area(scene):
        x, y, z = (scene.scales**2).unbind(dim=1)
        return (shares * torch.stack([y * z, z * x, x * y], dim=1)).sum(dim=1)

    factor = (area(SCENE) / area(wide)).sqrt()
    raw = project(SCENE, NEAR)
    filtered = Adaptive()(raw, NEAR, training)
    expected = raw.opacities * factor.clamp(min=0.005)
    torch.testing.assert_close(filtered.opacities, expected, rtol=1e-5, atol=1e-9)


def test_the_largest_focal_pairs_every_depth_with_it():
    """Mip-Splatting's code takes max f / min z, its paper max f/z: they differ where focal lengths do."""
    training = learn(SCENE, [NEAR, LONG])
    depths = torch.stack([project(SCENE, camera).depths for camera in (NEAR, LONG)])
    filtered = Smoothing3D(focal="largest")(SCENE, training)
    sigma = math.sqrt(0.2) * depths.amin(dim=0) / LONG.focal
    expected = 0.5 * (SCENE.scales**2 + sigma[:, None] ** 2).log()
    torch.testing.assert_close(filtered.log_scales, expected)
    own = Smoothing3D()(SCENE, training)
    assert (own.log_scales - filtered.log_scales).max() > 0.01
    alike = learn(SCENE, [NEAR, FAR])
    same = [Smoothing3D(focal=focal)(SCENE, alike).log_scales for focal in ("own", "largest")]
    torch.testing.assert_close(*same)


@pytest.mark.parametrize(
    ("thickness", "expected"), [((2.0, 2.0, 1e-3), 4 / 5), ((0.1, 0.1, 0.1), BALANCE_FLOOR)]
)
def test_balancing_goes_by_the_broadest_face_and_not_below_its_floor(thickness, expected):
    """Scales in units of the smoothing's own: a surfel twice as wide keeps 4/5, whatever its thickness."""
    scene = SCENE[:1]
    training = learn(scene, [NEAR])
    sigma = math.sqrt(0.2) / training.bounds.highest
    scene = replace(scene, log_scales=(sigma[:, None] * torch.tensor([thickness], dtype=F64)).log())
    balanced = Smoothing3D(opacity="balanced")(scene, training)
    assert (balanced.opacities / scene.opacities).item() == pytest.approx(expected, rel=1e-6)
