"""Camera paths, and reading nerfstudio's."""

import math
from dataclasses import replace

import pytest
import torch

from aaplug import CameraSet, FormatError, read_camera_path
from aaplug.core import camera_paths as paths
from aaplug.core.lenses import PINHOLE, Lens
from aaplug.io.cameras.camera_path import sniff
from tests.conftest import make_camera
from tests.scene_files import write_json

VIEW = make_camera((0.0, -4.0, 0.0))
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def test_a_zoom_goes_from_start_to_end_and_back_in_octaves_in_frames_with_numbers():
    views = [paths.zoomed(VIEW, paths.factor(t, 1.0, 0.25)) for t in (0.0, 0.25, 0.5, 0.75)]
    assert [view.fx / VIEW.fx for view in views] == pytest.approx([1.0, 0.5, 0.25, 0.5])
    assert {view.hw for view in views} == {VIEW.hw}
    frames = paths.frames(lambda t: paths.zoomed(VIEW, paths.factor(t, 1.0, 0.5)), 11)
    assert [frame.name for frame in frames][:2] == ["00", "01"]
    assert frames[1].fx == pytest.approx(frames[-1].fx)


def test_a_dolly_moves_along_the_axis_and_keeps_the_focal_length():
    far = paths.moved(VIEW, 0.25, depth=4.0)
    assert far.centre.tolist() == pytest.approx([0.0, -16.0, 0.0], abs=1e-9)
    assert (far.fx, far.trained_focal) == (VIEW.fx, None)


@pytest.mark.parametrize("t", [0.0, 0.25, 0.6])
def test_an_orbit_keeps_distance_and_looks_at_the_pivot(t):
    camera = paths.orbit(VIEW, t, 4.0, UP)
    assert camera.centre.norm().item() == pytest.approx(4.0)
    pivot = camera.cam_from_world[:3, 3]  # the origin, seen from the camera
    assert pivot.tolist() == pytest.approx([0.0, 0.0, 4.0], abs=1e-6)
    angle = math.atan2(camera.centre[1], camera.centre[0])
    assert math.cos(angle + math.pi / 2) == pytest.approx(math.cos(2 * math.pi * t))


@pytest.mark.parametrize("lens", [PINHOLE, Lens("equidistant")])
def test_paths_keep_what_the_middle_shows_where_the_principal_point_is_far_off(lens):
    view = replace(VIEW, cx=-1.5 * VIEW.width, cy=0.2 * VIEW.height, lens=lens)
    middle = torch.tensor([view.width / 2, view.height / 2], dtype=torch.float64)
    ray = view.rays(middle) @ view.cam_from_world[:3, :3]
    shown = view.centre + 4.0 / (view.cam_from_world[2, :3] @ ray) * ray
    for camera in (paths.zoomed(view, 0.25), paths.moved(view, 0.25, 4.0), paths.orbit(view, 0.3, 4.0, UP)):
        torch.testing.assert_close(camera.project(shown[None])[0][0], middle)


def test_up_is_what_is_up_in_the_images():
    views = (VIEW, make_camera((3.0, -1.0, 0.0)))
    assert paths.up_of(CameraSet(views, views)).tolist() == pytest.approx([0, 0, 1], abs=1e-9)


def document(**changes):
    pose = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 5, 0, 0, 0, 1]
    frame = {"camera_to_world": pose, "fov": 60.0, "aspect": 1.5}
    about = {"render_width": 60, "render_height": 40, "fps": 24, "camera_type": "perspective"}
    return about | {"camera_path": [frame]} | changes


def test_a_camera_path_is_opengl_with_a_vertical_angle(tmp_path):
    file = write_json(tmp_path / "camera_path.json", document())
    assert sniff(file)
    path = read_camera_path(file)
    (camera,) = path.cameras
    assert (path.fps, camera.width, camera.height) == (24, 60, 40)
    assert read_camera_path(file, fps=48.0).fps == 24  # its frames are listed
    assert camera.fy == pytest.approx(20 / math.tan(math.pi / 6))
    assert camera.centre.tolist() == pytest.approx([0, 0, 5])
    ahead = camera.cam_from_world @ torch.tensor([0.0, 1.0, 0.0, 1.0]).double()
    assert ahead.tolist() == pytest.approx([0, -1, 5, 1])  # before it, and up in the image
    assert camera.trained_focal is None


FAR = [1, 0, 0, 1e20, 0, 1, 0, 0, 0, 0, 1, 5, 0, 0, 0, 1]
BROKEN = {
    "no path": ([], "no camera path of a known format"),
    "a fisheye": (document(camera_type="fisheye"), "camera_type should be perspective"),
    "no frames": (document(camera_path=[]), "list of frames"),
    "no size": (document(render_width=0), "render_width"),
    "no time": (document(fps=0), "fps should be above 0"),
    "an angle": (document(camera_path=[document()["camera_path"][0] | {"fov": 180}]), "frame 0: fov"),
    "far away": (document(camera_path=[{"camera_to_world": FAR, "fov": 50}]), "camera 0: .* a translation of at most"),
    "a short pose": (document(camera_path=[{"camera_to_world": [1], "fov": 50}]), "camera_to_world"),
}  # fmt: skip
for wrong in ({"radius": 0, "focus": 3}, {"radius": 1}, {"radius": 1, "focus": 1, "blades": 2}, 3):
    lensed = document(camera_path=[document()["camera_path"][0] | {"aperture": wrong}])
    BROKEN[f"an aperture of {wrong}"] = lensed, "aperture|focus"


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_camera_path_is_refused_by_its_field(tmp_path, case):
    content, named = BROKEN[case]
    with pytest.raises(FormatError, match=named):
        read_camera_path(write_json(tmp_path / "camera_path.json", content))
