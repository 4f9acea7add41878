"""Camera paths of other programs: SuperSplat, LichtFeld Studio, glTF, USD, and the data sets' own formats."""

import base64
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from aaplug import AaplugError, FormatError, UsageError, read_camera_path, read_cameras
from aaplug.io.gltf import glb_start
from tests.scene_files import with_value
from tests.test_cameras_io import FIXTURES

SETTINGS = {
    "version": 2,
    "animTracks": [
        {
            "name": "cameraAnim", "duration": 2, "frameRate": 10, "loopMode": "none", "interpolation": "spline",
            "smoothness": 1,
            "keyframes": {
                "times": [0, 10, 20],
                "values": {
                    "position": [0, 0, 4, 1, 0, 4, 2, 0, 4], "target": [0, 0, 0, 1, 0, 0, 2, 0, 0], "fov": [60, 60, 60]
                },
            },
        }
    ],
}  # fmt: skip
HALF = math.sqrt(0.5)
TIMELINE = {
    "version": 4,
    "keyframes": [
        {"time": 0, "position": [0, 0, 4], "rotation": [1, 0, 0, 0], "focal_length_mm": 24, "easing": 0},
        {"time": 1, "position": [2, 0, 4], "rotation": [HALF, 0, HALF, 0], "focal_length_mm": 48, "easing": 3},
    ],
}


def gltf(binary: bytes, uri: str | None = None) -> dict:
    """A camera under a parent that moves by 1 per second for 2 s, 10 keys a second, and turns by 90° about y."""
    views = [(0, 84), (84, 252), (336, 8), (344, 32)]
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(binary)} | ({"uri": uri} if uri else {})],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": length} for start, length in views],
        "accessors": [
            {"bufferView": i, "componentType": 5126, "count": n, "type": kind}
            for i, (n, kind) in enumerate([(21, "SCALAR"), (21, "VEC3"), (2, "SCALAR"), (2, "VEC4")])
        ],
        "cameras": [{"type": "perspective", "perspective": {"yfov": math.pi / 2, "aspectRatio": 2, "znear": 0.1}}],
        "nodes": [{"children": [1]}, {"camera": 0, "translation": [0, 0, 5], "scale": [2, 2, 2]}],
        "animations": [
            {
                "samplers": [{"input": 0, "output": 1}, {"input": 2, "output": 3}],
                "channels": [
                    {"sampler": 0, "target": {"node": 0, "path": "translation"}},
                    {"sampler": 1, "target": {"node": 1, "path": "rotation"}},
                ],
            }
        ],
    }


def binary() -> bytes:
    times = np.arange(21, dtype="<f4") / 10
    places = np.stack([times, 0 * times, 0 * times], axis=1)
    return b"".join(
        x.astype("<f4").tobytes()
        for x in (times, places, np.array([0, 2]), np.array([[0, 0, 0, 1], [0, HALF, 0, HALF]]))
    )


def glb(folder: Path) -> Path:
    (folder / "path.glb").write_bytes(glb_start(gltf(binary()), len(binary())) + binary())
    return folder / "path.glb"


def gltf_with_buffer(folder: Path) -> Path:
    (folder / "path.bin").write_bytes(binary())
    return written(folder, "path.gltf", gltf(binary(), "path.bin"))


def gltf_with_data(folder: Path) -> Path:
    uri = "data:application/octet-stream;base64," + base64.b64encode(binary()).decode()
    return written(folder, "path.gltf", gltf(binary(), uri))


def written(folder: Path, name: str, content: object) -> Path:
    (folder / name).write_text(content if isinstance(content, str) else json.dumps(content))
    return folder / name


def forward(camera):
    return camera.cam_from_world[2, :3].tolist()


def test_supersplat_settings_are_turned_into_the_scenes_axes(tmp_path):
    path = read_camera_path(written(tmp_path, "settings.json", SETTINGS))
    assert (path.fps, len(path.cameras), path.unsized) == (10, 20, True)
    camera = path.cameras[5]
    assert camera.centre.tolist() == pytest.approx([-0.5, 0, 4])  # the keys lie on a line
    assert forward(camera) == pytest.approx([0, 0, -1])
    assert camera.cam_from_world[1, :3].tolist() == pytest.approx([0, 1, 0])  # up is -y
    assert 2 * math.degrees(math.atan(camera.width / 2 / camera.fx)) == pytest.approx(60)


def test_supersplat_settings_of_version_1_have_one_angle_of_view_and_tracks_may_repeat(tmp_path):
    first = {key: value for key, value in SETTINGS.items() if key != "version"} | {"camera": {"fov": 90}}
    track = json.loads(json.dumps(SETTINGS["animTracks"][0]))
    del track["keyframes"]["values"]["fov"]
    path = read_camera_path(written(tmp_path, "settings.json", first | {"animTracks": [track]}))
    assert path.cameras[0].fx == pytest.approx(path.cameras[0].width / 2)
    track |= {"loopMode": "repeat", "duration": 3}
    path = read_camera_path(written(tmp_path, "settings.json", first | {"animTracks": [track]}))
    places = [-camera.centre[0].item() for camera in path.cameras]
    assert len(places) == 30
    assert [places[0], places[10], places[20]] == pytest.approx([0, 1, 2])
    assert places[25] == pytest.approx(1, abs=0.2)  # on its way back


def test_lichtfelds_timeline_is_turned_into_the_scenes_axes_and_eased(tmp_path):
    path = read_camera_path(written(tmp_path, "timeline.json", TIMELINE))
    assert (path.fps, len(path.cameras)) == (30, 31)
    first, last = path.cameras[0], path.cameras[-1]
    assert first.centre.tolist() == pytest.approx([0, 0, -4])
    assert forward(first) == pytest.approx([0, 0, 1])
    assert forward(last) == pytest.approx([-1, 0, 0], abs=1e-6)
    assert 2 * math.degrees(math.atan(first.height / 2 / first.fy)) == pytest.approx(2 * math.degrees(math.atan(0.5)))
    assert last.fy == pytest.approx(2 * first.fy)


@pytest.mark.parametrize("make", [glb, gltf_with_buffer, gltf_with_data])
def test_a_camera_of_gltf_moves_with_the_nodes_above_it(tmp_path, make):
    path = read_camera_path(make(tmp_path))
    assert (path.fps, len(path.cameras)) == (10, 21)
    camera = path.cameras[10]
    assert camera.centre.tolist() == pytest.approx([1, 0, 5], abs=1e-6)
    assert forward(camera) == pytest.approx([-HALF, 0, -HALF], abs=1e-6)  # halfway of 90°
    assert (camera.width, camera.height, camera.fy) == (2160, 1080, pytest.approx(540))


@pytest.mark.parametrize("way", ["STEP", "CUBICSPLINE"])
def test_keys_of_gltf_step_or_lie_on_a_cubic(tmp_path, way):
    document = gltf(binary(), "path.bin")
    places = np.zeros((21, 3, 3), "<f4")
    places[:, 1, 0] = np.arange(21) / 10
    places[:, (0, 2), 0] = 1  # slopes of the line
    data = binary() + (places.tobytes() if way == "CUBICSPLINE" else places[:, 1].tobytes())
    document["buffers"][0]["byteLength"] = len(data)
    document["bufferViews"][1] = {"buffer": 0, "byteOffset": 376, "byteLength": len(data) - 376}
    document["accessors"][1]["count"] = 63 if way == "CUBICSPLINE" else 21
    document["animations"][0]["samplers"][0]["interpolation"] = way
    (tmp_path / "path.bin").write_bytes(data)
    cameras = read_camera_path(written(tmp_path, "path.gltf", document)).cameras
    assert [round(camera.centre[0].item(), 4) for camera in cameras] == [round(x / 10, 4) for x in range(21)]


def test_sparse_keys_of_gltf_are_no_frames_and_scales_move_what_is_below(tmp_path):
    document = gltf(binary(), "path.bin")
    document["accessors"][0]["count"] = document["accessors"][1]["count"] = 3
    [animation] = document["animations"]
    animation["channels"][0]["target"]["path"] = "scale"
    times, sizes = np.arange(3, dtype="<f4"), np.repeat(np.arange(1, 4, dtype="<f4"), 3)
    turns = np.array([0, 0, 0, 127, 0, 90, 0, 90], "<i1")  # gltfpack writes integers
    document["accessors"][3] |= {"componentType": 5120, "normalized": True}
    data = b"".join(part.tobytes().ljust(size) for part, size in ((times, 84), (sizes, 252)))
    (tmp_path / "path.bin").write_bytes(data + binary()[336:344] + turns.tobytes().ljust(32))
    path = read_camera_path(written(tmp_path, "path.gltf", document))
    assert (path.fps, len(path.cameras)) == (30, 61)
    assert path.cameras[30].centre.tolist() == pytest.approx([0, 0, 10])
    assert forward(path.cameras[-1]) == pytest.approx([-1, 0, 0], abs=1e-6)


@pytest.mark.parametrize("uri", ["../path.bin", "/etc/hostname", "http://x/path.bin", "a\0b", "none.bin"])
def test_no_buffer_is_read_beyond_the_folder(tmp_path, uri):
    (tmp_path / "in").mkdir()
    (tmp_path / "path.bin").write_bytes(binary())
    with pytest.raises(FormatError):
        read_camera_path(written(tmp_path / "in", "path.gltf", gltf(binary(), uri)))


USDA = """#usda 1.0
(
    startTimeCode = 1
    endTimeCode = 3
    timeCodesPerSecond = 24
    metersPerUnit = 1
)
def Xform "rig"
{
    double3 xformOp:translate.timeSamples = { 1: (0, 0, 5), 3: (2, 0, 5) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
    rel material:binding = </rig/cam>
    def Camera "cam"
    {
        float focalLength.timeSamples = { 1: 18, 3: 36 }
        float horizontalAperture = 36
        float verticalAperture = 18
        float horizontalApertureOffset = 3.6
        float fStop = 2
        float focusDistance = 5
        double shutter:open = -0.25
        double shutter:close = 0.25
    }
}
"""

STILL = """{ 1: (0, 0, 7) }
    uniform token[] xformOpOrder = ["xformOp:translate"]
    def Camera "cam"
    {
        float focalLength.timeSamples = { 1: 18 }
        """


def test_a_camera_of_usd_brings_lens_aperture_and_shutter(tmp_path):
    pytest.importorskip("pxr")
    path = read_camera_path(written(tmp_path, "path.usda", USDA))
    assert (path.fps, path.shutter, len(path.cameras)) == (24, 0.5, 3)
    first, middle, _ = path.cameras
    assert (first.width, first.height, first.fx, first.cx) == (1920, 960, 960, pytest.approx(768))
    assert middle.centre.tolist() == pytest.approx([1, 0, 5])
    assert middle.fx == pytest.approx(1440)
    assert forward(middle) == pytest.approx([0, 0, -1])
    assert first.exposure.aperture.radius == pytest.approx(1.8 / 2 / 2)
    assert first.exposure.aperture.focus == 5


@pytest.mark.parametrize(
    ("old", "new", "frames", "z"),
    [
        ("timeCodesPerSecond = 24", "timeCodesPerSecond = 12\n framesPerSecond = 24", 5, 5),
        ("{ 1: (0, 0, 5), 3: (2, 0, 5) }", "{ 1: (0, 0, 7) }", 3, 7),
        (USDA[USDA.index("{ 1: (0") : USDA.index("double shutter:open")], STILL, 1, 7),
    ],
    ids=["ticks", "one key beside others", "one key"],
)
def test_frames_of_usd_are_those_of_its_stage_and_one_key_holds(tmp_path, old, new, frames, z):
    pytest.importorskip("pxr")
    assert USDA.count(old) == 1
    other = 'def Camera "other"\n{\n token visibility.timeSamples = { 1: "inherited", 3: "invisible" }\n}\n'
    text = USDA.replace(old, new).replace("def Xform", (frames > 1) * other + "def Xform")
    path = read_camera_path(written(tmp_path, "path.usda", text))
    assert (path.fps, len(path.cameras), path.cameras[-1].centre[2].item(), path.unsized) == (24, frames, z, True)
    assert path.shutter == (0.5 if frames < 5 else 1)


@pytest.mark.parametrize("variant", [False, True])
def test_values_of_other_layers_are_not_read(tmp_path, variant):
    pytest.importorskip("pxr")
    clips = "clips = { dictionary a = { asset[] assetPaths = [@../out.usda@] } }"
    inner = f'variantSet "v" = {{ "x" (\n{clips}\n) {{ }} }}' if variant else ""
    outer = 'variants = { string v = "x" }\nprepend variantSets = "v"' if variant else clips
    text = USDA.replace('"rig"\n{', f'"rig" (\n{outer}\n)\n{{\n{inner}')
    with pytest.raises(FormatError, match="has value clips, which are other layers"):
        read_camera_path(written(tmp_path, "path.usda", text))


@pytest.mark.parametrize("layer", ["../out.usda", "/etc/out.usda", "http://x/a.usda"])
def test_no_layer_is_read_beyond_the_folder(tmp_path, layer):
    pytest.importorskip("pxr")
    (tmp_path / "in").mkdir()
    (tmp_path / "out.usda").write_text(USDA)
    text = f'#usda 1.0\ndef "x" ( references = @{layer}@</rig> ) {{}}\n'
    with pytest.raises(FormatError, match=r"outside|missing"):
        read_camera_path(written(tmp_path / "in", "path.usda", text))
    inside = "#usda 1.0\n(\n subLayers = [@inner.usda@]\n startTimeCode = 1\n endTimeCode = 2\n)\n"
    written(tmp_path / "in", "inner.usda", USDA)
    assert len(read_camera_path(written(tmp_path / "in", "outer.usda", inside)).cameras) == 2


def test_usd_without_its_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match="usd"):
        read_camera_path(written(tmp_path, "path.usda", USDA))


@pytest.mark.parametrize(
    ("name", "document"), [("a.json", SETTINGS), ("a.json", TIMELINE), ("a.usda", USDA), ("", None)]
)
def test_a_path_of_keys_lasts_as_long_at_another_frame_rate(tmp_path, name, document):
    if document == USDA:
        pytest.importorskip("pxr")
    file = written(tmp_path, name, document) if name else glb(tmp_path)
    path = read_camera_path(file)
    finer = read_camera_path(file, fps=2 * path.fps)
    assert (finer.fps, finer.shutter) == (2 * path.fps, path.shutter)
    for one, other in zip(path.cameras, finer.cameras[::2], strict=True):
        torch.testing.assert_close(one.cam_from_world, other.cam_from_world)
        assert (one.fx, one.trained_focal) == (pytest.approx(other.fx), None)


@pytest.mark.parametrize("name", ["colmap", "transforms", "inria", "pinhole", "blender"])
def test_cameras_of_a_data_set_are_a_path_in_their_order(tmp_path, name):
    make, _ = FIXTURES[name]
    cameras = read_camera_path(make(tmp_path)).cameras
    assert cameras
    assert all(camera.trained_focal is None and camera.photo is None for camera in cameras)


WRONG = [
    ("a.json", SETTINGS, ("animTracks", 0, "keyframes", "times"), [0, 5, 5]),
    ("a.json", SETTINGS, ("animTracks", 0, "keyframes", "values", "fov"), [60, 180, 60]),
    ("a.json", SETTINGS, ("animTracks", 0, "keyframes", "values", "target"), [0, 0, 4] * 3),  # at the camera
    ("a.json", SETTINGS, ("animTracks", 0, "duration"), 1e9),
    ("a.json", SETTINGS, ("version",), 3),
    ("a.json", TIMELINE, ("version",), 5),
    ("a.json", TIMELINE, ("keyframes", 1, "rotation"), [0, 0, 0, 0]),
    ("a.json", TIMELINE, ("keyframes", 1, "easing"), 0.5),
    ("a.json", TIMELINE, ("keyframes", 1, "focal_length_mm"), 0),
    ("a.gltf", gltf(b"", "x"), ("nodes",), [{}]),  # no camera
    ("a.gltf", gltf(b"", "x"), ("nodes", 1, "children"), [0]),  # a circle
    ("a.gltf", gltf(b"", "x"), ("cameras", 0, "type"), "orthographic"),
    ("a.gltf", gltf(b"", "data:,"), ("buffers", 0, "byteLength"), 5),
    ("a.gltf", gltf(b"", "x"), ("asset", "version"), "1.0"),
]


def test_numbers_of_gltf_that_many_channels_share_have_a_limit_in_all(tmp_path, monkeypatch):
    document = gltf(binary(), "path.bin")
    document["nodes"] += [{}] * 40
    document["animations"][0]["channels"] += [
        {"sampler": 0, "target": {"node": node, "path": "translation"}} for node in range(2, 42)
    ]
    (tmp_path / "path.bin").write_bytes(binary())
    file = written(tmp_path, "path.gltf", document)
    assert len(read_camera_path(file).cameras) == 21
    monkeypatch.setenv("AAPLUG_JSON", str(max(8000, file.stat().st_size)))
    with pytest.raises(FormatError, match="count should be at most 2,000 numbers in all"):
        read_camera_path(file)


@pytest.mark.parametrize(("name", "document", "place", "value"), WRONG, ids=range(len(WRONG)))
def test_a_broken_path_is_refused(tmp_path, name, document, place, value):
    with pytest.raises(FormatError):
        read_camera_path(written(tmp_path, name, with_value(document, place, value)))


def test_garbage_is_refused(tmp_path):
    for name in ("a.json", "a.gltf", "a.glb", "a.usda"):
        (tmp_path / name).write_bytes(b"\x00\x01garbage")
        with pytest.raises(AaplugError):
            read_camera_path(tmp_path / name)
    with pytest.raises(FormatError, match="format of camera paths, which `path` of render and video takes"):
        read_cameras(tmp_path / "a.usda")
    with pytest.raises(FormatError, match="guide film-camera"):
        read_camera_path(written(tmp_path, "a.abc", "Ogawa"))
