"""The add-on for Blender, run in a Python that has `bpy`: this one, or the one that AAPLUG_BPY names."""

import json
import os
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

import aaplug
from aaplug import read_camera_path, read_cameras, read_scene
from tests.conftest import ROOT, SAMPLE

ADD_ON = ROOT / "examples" / "blender" / "aaplug_camera.py"
PYTHON = os.environ.get("AAPLUG_BPY") or (sys.executable if find_spec("bpy") else "")
pytestmark = pytest.mark.skipif(not PYTHON, reason="no Python with bpy; AAPLUG_BPY names one")
PROGRAM = "#!/bin/sh\nexec '{python}' -c 'from aaplug_cli.main import program; program()' \"$@\"\n"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("blender")
    program = folder / "aaplug"
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    scene = [str(program), str(SAMPLE / "chair.ply"), str(SAMPLE)]
    script = [PYTHON, str(ROOT / "tests" / "blender_scene.py"), str(ADD_ON), str(folder), *scene]
    done = subprocess.run(script, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
    return folder, json.loads((folder / "result.json").read_text())


def offsets(camera, rows):
    """Distances in px between where Blender sees points and where the camera projects them."""
    rows = torch.tensor(rows, dtype=torch.float64)
    places, depths = camera.project(rows[:, :3])
    assert bool((depths > 0).all())
    return (places - torch.stack([rows[:, 3] * camera.width, (1 - rows[:, 4]) * camera.height], dim=1)).norm(dim=1)


def test_an_animated_camera_sees_points_where_blender_does(exported):
    folder, result = exported
    path = read_camera_path(folder / "camera_path.json")
    assert (len(path.cameras), path.fps, path.shutter) == (5, 25, pytest.approx(0.4))
    assert (path.cameras[0].width, path.cameras[0].height) == (640, 267)
    assert path.cameras[0].fx < 0.5 * path.cameras[-1].fx
    assert path.cameras[0].cx != path.cameras[-1].cx
    for camera, rows in zip(path.cameras, result["seen"], strict=True):
        assert float(offsets(camera, rows).max()) < 0.01


def test_focus_and_f_stop_become_an_aperture(exported):
    aperture = read_camera_path(exported[0] / "camera_path.json").cameras[0].exposure.aperture
    assert (aperture.radius, aperture.focus, aperture.blades) == (pytest.approx(0.035 / 4), pytest.approx(7), 6)


def test_the_focus_follows_an_object_also_one_behind_and_a_bone(exported):
    _, result = exported
    assert result["behind"]["focus"] == pytest.approx(4, rel=1e-5)
    assert result["bone"]["focus"] == pytest.approx(5, rel=1e-5)
    assert result["in the lens"] == "frame 3 has a focus distance of 0"
    assert result["subframe"] == 0.5


def test_an_object_stands_for_the_splats_frame(exported):
    folder, result = exported
    [camera] = read_camera_path(folder / "moved.json").cameras
    assert float(offsets(camera, result["local"]).max()) < 0.01
    assert camera.exposure.aperture.focus == pytest.approx(3.5)


def test_frames_are_drawn_and_loaded(exported):
    _, result = exported
    assert result["draw"] == result["draw again"] == ["FINISHED"]
    assert result["background"] == [640, 267, "SEQUENCE", 5]
    assert result["node"] == ["aaplug", "0.webp", 255, 128, 0]
    assert "Error: nothing.ply" in result["no scene"]
    assert "Program: no-such-program cannot be started: No such file" in result["no program"]
    assert "false ended with status 1" in result["silent"]
    assert "Folder: save the .blend file first" in result["not saved"]
    assert "Splats: choose a scene" in result["no splats"]
    assert result["region"] == 640
    assert "Crop to Render Region: aaplug draws the whole frame; switch it off" in result["cropped"]
    assert "Frame: its scale should be the same along all axes" in result["stretched"]


def test_layers_of_an_exr_are_outputs_of_an_image_node_by_name(tmp_path):
    pytest.importorskip("OpenEXR", reason="the extra exr is not installed")
    passes = ["rgb", "alpha", "depth", "normal", "position", "id"]
    scene, cameras = read_scene(SAMPLE / "chair.ply"), read_cameras(SAMPLE)
    aaplug.render(scene, cameras, tmp_path / "a.exr", views="r_8", resolution="64x64", passes=passes)
    script = (
        "import bpy, sys\n"
        "bpy.context.scene.use_nodes = True\n"
        "tree = getattr(bpy.context.scene, 'node_tree', None) or bpy.data.node_groups.new('a', 'CompositorNodeTree')\n"
        "node = tree.nodes.new('CompositorNodeImage')\n"
        "node.image = bpy.data.images.load(sys.argv[1])\n"
        "print('outputs', *(output.name for output in node.outputs if output.enabled))\n"
    )
    done = subprocess.run(
        [PYTHON, "-c", script, str(tmp_path / "a.exr")], capture_output=True, text=True, timeout=500, check=True
    )
    [line] = [line for line in done.stdout.splitlines() if line.startswith("outputs")]
    assert line.split()[1:] == ["Combined", "Alpha", "depth", "id", "normal", "position"]
