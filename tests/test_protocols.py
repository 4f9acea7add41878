"""Protocols: what a scale does to a camera."""

from dataclasses import replace

import pytest
import torch

from aaplug import PROTOCOLS, UsageError
from aaplug.core.camera_paths import median_depth
from aaplug.evaluation.metrics import SSIM
from aaplug.io.photographs import DOWNSCALES
from tests.conftest import make_camera, make_scene


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=lambda p: p.name)
def test_scale_one_is_the_view_itself_and_names_exist(protocol):
    view = make_camera()
    camera = protocol.camera(view, 1.0, 4.0)
    assert (camera.hw, camera.intrinsics) == (view.hw, view.intrinsics)
    assert camera.cam_from_world.equal(view.cam_from_world)
    assert (protocol.downscale in DOWNSCALES, protocol.ssim in SSIM, bool(protocol.source)) == (True, True, True)


@pytest.mark.parametrize("protocol", PROTOCOLS.values(), ids=lambda p: p.name)
@pytest.mark.parametrize("scale", [0.25, 2.0])
def test_every_protocol_samples_what_is_in_the_middle_by_the_scale(protocol, scale):
    view = make_camera((0.0, -4.0, 0.0))
    camera = protocol.camera(view, scale, 4.0)
    depth = camera.cam_from_world[2, 3].item()  # of the world's origin, which the view looks at
    assert camera.fx / depth == pytest.approx(scale * view.fx / 4.0)


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
