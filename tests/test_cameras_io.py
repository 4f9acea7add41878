"""Cameras from every format: values checked by hand, one scene in all its formats, and hostile files."""

import errno
import json
import math
import os
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

import aaplug
from aaplug import CameraFileOptions, CameraSet, FormatError, UsageError, write_scene
from aaplug.core.colours import BLACK, WHITE
from aaplug.core.conventions import CLASSIC, KHR
from aaplug.core.lenses import EQUIRECT, PINHOLE, opencv_lens
from aaplug.io.cameras import OWN, read_cameras, select_views
from aaplug.io.cameras.inria import read_cfg_args
from aaplug.io.cameras.photos import without_suffix
from aaplug.io.cameras.poses import inverse
from aaplug.system.registry import Registry, named
from tests.conftest import make_camera, make_scene
from tests.scene_files import with_value, write_json
from tests.test_camera_paths import document

QUARTER_TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]  # 90° about z
TURNED = [0.0, -1.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 1.0]  # and moved, row by row


def photo(path, width, height, mode="RGB"):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new(mode, (width, height)).save(path)


def names(cameras):
    return [camera.name for camera in cameras]


def refused(path, *messages):
    with pytest.raises(FormatError) as caught:
        read_cameras(path)
    assert all(message in str(caught.value) for message in messages)


def values(camera):
    return camera.fx, camera.fy, camera.cx, camera.cy


# INRIA ------------------------------------------------------------------------------------------


def inria_entry(name="a", **changes):
    pose = {"position": [1.0, 2.0, 3.0], "rotation": QUARTER_TURN}
    return {"id": 0, "img_name": name, "width": 400, "height": 200, "fx": 300.0, "fy": 310.0} | pose | changes


def inria(folder, *entries, cfg=None):
    write_json(folder / "cameras.json", list(entries or [inria_entry()]))
    if cfg is not None:
        (folder / "cfg_args").write_text(cfg)
    return folder


def many(count):
    """Views v00, v01 ... one step apart, the test views first, as 3DGS writes them."""
    order = [i for i in range(count) if i % 8 == 0] + [i for i in range(count) if i % 8]
    return [inria_entry(f"v{i:02}", position=[float(i), 0, 0]) for i in order]


def test_inria_pose_is_the_inverse_of_camera_to_world(tmp_path):
    (camera,) = read_cameras(inria(tmp_path)).train
    expected = torch.tensor([[0, 1, 0, -2], [-1, 0, 0, 1], [0, 0, 1, -3], [0, 0, 0, 1]], dtype=torch.float64)
    assert torch.equal(camera.cam_from_world, expected)
    assert camera.centre.tolist() == [1, 2, 3]
    assert values(camera) == (300, 310, 200, 100)
    assert (camera.name, camera.hw, camera.trained_focal) == ("a", (200, 400), camera.focal)
    rough = [[0.0, -1.0002, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.9999]]
    (camera,) = read_cameras(inria(tmp_path, inria_entry("y" * 5000, rotation=rough))).train
    turn = camera.cam_from_world[:3, :3]
    assert torch.allclose(turn @ turn.T, torch.eye(3, dtype=torch.float64), atol=1e-15), "made orthonormal"


@pytest.mark.parametrize(
    ("cfg", "size"),
    [
        (None, (1600, 666)),  # the assumed cap: 1000 · 1600 / 2402 = 666.1
        ("Namespace(resolution=-1)", (1600, 666)),
        ("Namespace(resolution=1)", (2402, 1000)),
        ("Namespace(resolution=4)", (600, 250)),  # 600.5 goes to the even 600, as in 3DGS
        ("Namespace(resolution=1200)", (1200, 499)),
        ("Namespace(resolution=-1, images='images_4')", (601, 250)),  # image tools round 600.5 up
    ],
)
def test_inria_training_size_follows_3dgs(tmp_path, cfg, size):
    cameras = read_cameras(inria(tmp_path, inria_entry(width=2402, height=1000), cfg=cfg))
    (camera,) = cameras.train
    assert (camera.width, camera.height, camera.fx) == (*size, pytest.approx(300 * size[0] / 2402))
    assert camera.trained_focal == camera.focal
    assert any("training size" in n and str(size[0]) in n for n in cameras.notes)
    assert any("assumed" in n for n in cameras.notes) == (cfg is None)


def test_inria_photos_count_more_than_the_sizes_in_the_file(tmp_path):
    photo(tmp_path / "images_4" / "a.JPG", 100, 50)
    inria(tmp_path, inria_entry(), inria_entry("b"), cfg="Namespace(images='images_4')")
    with_photo, without = read_cameras(tmp_path).train
    assert (with_photo.width, with_photo.photo) == (100, tmp_path / "images_4" / "a.JPG")
    assert (without.width, without.photo) == (100, None)
    photo(tmp_path / "images_4" / "b.png", 100, 200)
    refused(tmp_path, "100×200 px, which is not the shape")


def test_names_of_inria_lose_a_suffix_that_tells_no_views_apart(tmp_path):
    photo(tmp_path / "images" / "c" / "a.JPG", 400, 200)
    views = [inria_entry("c/a.JPG"), inria_entry("b", position=[0.0, 0, 0])]
    cameras = read_cameras(inria(tmp_path, *views, cfg="Namespace()"))
    assert names(cameras.train) == ["b", "c/a"]
    assert cameras.train[1].photo == tmp_path / "images" / "c" / "a.JPG"
    views = [inria_entry("a.png"), inria_entry("a.jpg")]
    assert names(read_cameras(inria(tmp_path, *views)).train) == ["a.jpg", "a.png"]


def test_inria_split_goes_by_name(tmp_path):
    inria(tmp_path, *many(17), cfg="Namespace(eval=True, white_background=True)")
    cameras = read_cameras(tmp_path)
    assert (names(cameras.test), len(cameras.train)) == (["v00", "v08", "v16"], 14)
    assert cameras.background == WHITE
    assert names(read_cameras(tmp_path, test_every=16).test) == ["v00", "v16"]
    undivided = read_cameras(tmp_path, test_every=0)
    assert undivided.train is undivided.test
    assert len(undivided.train) == 17
    cameras = read_cameras(inria(tmp_path, *many(9), cfg="Namespace(white_background=False)"))
    assert (len(cameras.train), len(cameras.test), cameras.background) == (9, 9, BLACK)
    assert read_cameras(inria(tmp_path / "bare", *many(9))).background is None


def test_inria_copies_of_a_view_count_once_and_other_views_of_a_name_are_a_second_list(tmp_path):
    """The model of a Blender set lists its test views first; some models list a view once per split."""
    cameras = read_cameras(inria(tmp_path, inria_entry(), inria_entry(id=1), inria_entry("b")))
    assert names(cameras.train) == ["a", "b"]
    test = [inria_entry(f"r_{i}", position=[float(i), 0, 0]) for i in range(3)]
    train = [inria_entry(f"r_{i}", position=[0, float(i) + 1, 0]) for i in range(2)]
    cameras = read_cameras(inria(tmp_path, *test, *train, cfg="Namespace(eval=True)"))
    assert (names(cameras.test), names(cameras.train)) == (["r_0", "r_1", "r_2"], ["r_0", "r_1"])
    merged = read_cameras(inria(tmp_path, *test, *train, cfg="Namespace(eval=False)"))
    assert sorted(names(merged.train)) == ["r_0", "r_0~2", "r_1", "r_1~2", "r_2"]


def test_cfg_args_is_never_run(tmp_path):
    trap = tmp_path / "trap"
    with pytest.raises(FormatError, match="eval should be a literal"):
        read_cameras(inria(tmp_path, cfg=f"Namespace(resolution=1, eval=open({str(trap)!r}, 'w'))"))
    assert not trap.exists()
    (tmp_path / "cfg_args").write_text(r"Namespace(source_path='D:\data\scene', resolution=2)")  # of Windows
    assert read_cfg_args(tmp_path / "cfg_args").resolution == 2


def test_where_training_had_its_photos_is_told_and_not_read(tmp_path):
    photo(tmp_path / "data" / "images" / "a.png", 400, 200)
    root = inria(tmp_path / "model", cfg=f"Namespace(source_path={str(tmp_path / 'data')!r})")
    note = f"photos: none found; training had them in {tmp_path / 'data'}/images; `images` names a folder"
    assert read_cameras(root).notes[-1] == note
    found = read_cameras(root, images=str(tmp_path / "data" / "images"))
    assert (found.train[0].photo is not None, note in found.notes) == (True, False)


def test_the_inverse_of_a_pose_does_not_depend_on_its_layout_in_memory():
    pose = make_camera((1.3, -4.1, 0.7)).cam_from_world
    pose[:3, 3] = torch.tensor([1.3, -4.1, 0.7])
    assert inverse(pose).equal(inverse(pose.T.contiguous().T))


def test_longer_json_than_the_limit_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv("AAPLUG_JSON", "100")
    refused(inria(tmp_path), "longer than 100 bytes")


# COLMAP -----------------------------------------------------------------------------------------

CAMERAS = ((1, 1, 400, 200, (300.0, 310.0, 199.0, 101.0)), (7, 0, 400, 200, (250.0, 200.0, 100.0)))
MODEL_NAMES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
IMAGES = (  # a quarter turn about z, not of unit length; no turn
    (5, (2.0, 0.0, 0.0, 2.0), (1.0, 2.0, 3.0), 1, "cam b/with space.jpg"),
    (3, (1.0, 0.0, 0.0, 0.0), (0.0, 0.5, 0.25), 7, "a.b.png"),
)
POINTS = ((1.5, 2.5, 9), (3.5, 4.5, 2**64 - 1))


def colmap_bin(folder, cameras=CAMERAS, images=IMAGES):
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(cameras))
    for key, model, width, height, values in cameras:
        data += struct.pack(f"<IiQQ{len(values)}d", key, model, width, height, *values)
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(images))
    for key, quaternion, translation, camera, name in images:
        data += struct.pack("<I7dI", key, *quaternion, *translation, camera) + name.encode() + b"\0"
        data += struct.pack("<Q", len(POINTS)) + b"".join(struct.pack("<2dQ", *p) for p in POINTS)
    (folder / "images.bin").write_bytes(data)
    return folder


def colmap_txt(folder, cameras=CAMERAS, images=IMAGES, points="1.5 2.5 9 3.5 4.5 -1"):
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list", ""]
    for key, model, width, height, values in cameras:
        lines.append(" ".join(map(str, (key, MODEL_NAMES[model], width, height, *values))))
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list"]
    for key, quaternion, translation, camera, name in images:
        lines += [" ".join(map(str, (key, *quaternion, *translation, camera, name))), points]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("name", ["a.png", "0001", "a b c.png"])
def test_a_text_model_without_lines_of_points_loses_no_view(tmp_path, name):
    """COLMAP takes every second line for points, whatever it holds."""
    views = tuple((i, (1.0, 0, 0, 0), (0.0, 0, 0), 1, f"{i}{name}") for i in range(3))
    colmap_txt(tmp_path, images=views, points="")
    assert len(read_cameras(tmp_path).all) == 3
    file = tmp_path / "images.txt"
    file.write_text(file.read_text().replace("\n\n", "\n"))
    refused(tmp_path, "images.txt: line 3: it should be the points of the image above, X Y POINT3D_ID each, or empty")


def one_camera(model, values):
    return ((1, model, 400, 200, values),), ((1, (1.0, 0, 0, 0), (0.0, 0, 0), 1, "a.png"),)


@pytest.mark.parametrize("write", [colmap_bin, colmap_txt])
def test_colmap_values(tmp_path, write):
    write(tmp_path / "sparse" / "0")
    photo(tmp_path / "images" / "a.b.png", 400, 200)
    for place in (".", "sparse", "sparse/0", f"sparse/0/images.{'bin' if write is colmap_bin else 'txt'}"):
        first, second = read_cameras(tmp_path / place, test_every=0).train
        assert (first.name, *values(first), first.hw) == ("a.b", 250, 250, 200, 100, (200, 400))
        assert (second.name, *values(second)) == ("cam b/with space", 300, 310, 199, 101)
        assert (first.photo, first.trained_focal) == (tmp_path / "images" / "a.b.png", 250)
    turned = torch.tensor([[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]], dtype=torch.float64)
    assert torch.allclose(second.cam_from_world, turned, atol=1e-15)
    assert first.cam_from_world[:3, 3].tolist() == [0, 0.5, 0.25]


def test_colmap_trains_at_the_size_of_its_photos(tmp_path):
    colmap_bin(tmp_path / "sparse")
    photo(tmp_path / "images_4" / "a.b.png", 100, 50)
    photo(tmp_path / "images_4" / "cam b" / "with space.jpg", 100, 50)
    first, second = read_cameras(tmp_path, images="images_4", test_every=0).train
    assert (first.width, first.fx, first.cx) == (100, 62.5, 50)
    assert values(second) == (75, 77.5, 49.75, 25.25)
    assert second.trained_focal == second.focal
    (scaled, _) = read_cameras(tmp_path, images="images_4", test_every=0, train_scale=0.5).train
    assert (scaled.width, scaled.fx) == (200, 125)


@pytest.mark.parametrize("file", ["写真\u3000é.webp", "写真\u3000e\u0301.jpg", "写真\u3000é.TIF"])
def test_a_photo_is_found_by_another_suffix_or_spelling(tmp_path, file):
    """Files may be converted after COLMAP ran, and macOS writes an accent as a letter of its own."""
    views = ((1, (1.0, 0, 0, 0), (0.0, 0, 0), 1, "写真\u3000é.jpg"),)
    photo(tmp_path / "images" / file, 400, 200)
    for write in (colmap_bin, colmap_txt):
        assert read_cameras(write(tmp_path / "sparse", images=views)).train[0].photo == tmp_path / "images" / file


def test_colmap_names_that_collide_keep_their_suffix(tmp_path):
    views = tuple((i, (1.0, 0, 0, 0), (0.0, 0, 0), 1, f"a.{s}") for i, s in enumerate(["jpg", "png"]))
    assert names(read_cameras(colmap_bin(tmp_path, images=views)).all) == ["a.png", "a.jpg"]
    with pytest.raises(FormatError, match=r"'a\.jpg' is there twice"):
        read_cameras(colmap_bin(tmp_path, images=views[:1] * 2))


@pytest.mark.parametrize("write", [colmap_bin, colmap_txt])
@pytest.mark.parametrize(("model", "coefficients"), [(4, (0.0,) * 4), (4, (0.0, 0.0, 0.0, 1e-9)), (5, (0.0,) * 4)])
def test_a_colmap_lens_has_its_coefficients_in_order(tmp_path, write, model, coefficients):
    photo(tmp_path / "images" / "a.png", 200, 100)
    path = write(tmp_path / "sparse", *one_camera(model, (300.0, 310.0, 200.0, 100.0, *coefficients))).parent
    cameras = read_cameras(path, undistort=True)
    (camera,), (bent,) = cameras.train, read_cameras(path).train
    lens = opencv_lens(coefficients, fisheye=model == 5) if model == 5 or any(coefficients) else PINHOLE
    assert values(camera) == values(bent) == (150, 155, 100, 50), "at its photo's size"
    assert (camera.lens, bent.lens, bent.photo) == (PINHOLE, lens, camera.photo)
    assert (camera.undistortion is None) == (lens == PINHOLE)
    assert camera.undistortion is None or camera.undistortion.lens == lens
    distorts = f"1 camera with another lens than a pinhole ({MODEL_NAMES[model]})"
    assert any(distorts in note for note in cameras.notes) == (lens != PINHOLE)
    unknown = read_cameras(colmap_bin(tmp_path / "sparse", *one_camera(7, (300.0, 310.0, 200.0, 100.0, 0.9))))
    assert unknown.train[0].photo is None
    assert "pinhole (FOV): drawn as pinholes, without photos" in unknown.notes[-1]


@pytest.mark.parametrize("kind", ["colmap", "transforms"])
def test_a_panorama_is_taken_as_it_is(tmp_path, kind):
    if kind == "colmap":
        colmap_txt(tmp_path / "sparse", *one_camera(1, (300.0, 310.0, 200.0, 100.0)))
        (tmp_path / "sparse" / "cameras.txt").write_text("1 EQUIRECTANGULAR 400 200 400 200\n")
    else:  # fl_x is nerfstudio's, no focal length in px per radian
        frames = [{"file_path": "images/a.png", "camera_model": "EQUIRECTANGULAR", "fl_x": 200, "cx": 7}]
        write_json(tmp_path / "transforms.json", transforms(frames, w=400, h=200))
    path, width = tmp_path / "images" / "a.png", 200 if kind == "colmap" else 400
    photo(path, 200, 100)
    cameras = read_cameras(tmp_path)
    (camera,) = cameras.train
    assert (camera.lens, camera.photo, camera.undistortion) == (EQUIRECT, path, None)
    assert camera.hw == (width // 2, width)
    assert (
        "1 camera with another lens than a pinhole (EQUIRECTANGULAR): renders are panoramas, too" in cameras.notes[-1]
    )
    assert not any("distorts" in note for note in cameras.notes)
    right, down = torch.eye(3, dtype=torch.float64)[:2] @ camera.cam_from_world[:3, :3]
    pixels, _ = camera.project(torch.stack([camera.centre + right, camera.centre + down]))
    torch.testing.assert_close(pixels[0], torch.tensor([0.75 * width, 0.25 * width], dtype=torch.float64))
    assert float(pixels[1, 1]) == pytest.approx(width / 2), "the last row looks down"
    with pytest.raises(FormatError, match=r"camera a: its photograph is a panorama \(EQUIRECTANGULAR\), which"):
        read_cameras(tmp_path, undistort=True)


def test_colmap_models_have_their_number_of_parameters(tmp_path):
    """The cameras that follow are read only if each one's parameters were all read and no more."""
    counts = [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2]
    first = [(10 + model, model, 400, 200, (1.0,) * count) for model, count in enumerate(counts)]
    assert len(read_cameras(colmap_bin(tmp_path, (*first, *CAMERAS))).all) == 2


def test_colmap_cut_anywhere_is_refused(tmp_path):
    colmap_bin(tmp_path)
    for name in ("cameras.bin", "images.bin"):
        data = (tmp_path / name).read_bytes()
        for length in [*range(0, len(data), 11), len(data) - 1]:
            (tmp_path / name).write_bytes(data[:length])
            with pytest.raises(FormatError, match=name) as caught:
                read_cameras(tmp_path)
        (tmp_path / name).write_bytes(data)
    assert "points of image record 1 need 48 bytes at least, and 47 are left" in str(caught.value)


def test_photo_behind_a_link_out_of_the_dataset_is_refused(tmp_path):
    photo(tmp_path / "elsewhere" / "a.b.png", 400, 200)
    root = tmp_path / "root"
    colmap_bin(root / "sparse")
    (root / "images").mkdir()
    (root / "images" / "a.b.png").symlink_to(tmp_path / "elsewhere" / "a.b.png")
    refused(root, "lies outside", "; pass `images` to allow another folder, or where a link leads there, copy it, or")
    (root / "images" / "a.b.png").unlink()
    (root / "images").rmdir()
    (root / "images").symlink_to(tmp_path / "elsewhere")
    refused(root, "lies outside")
    assert read_cameras(root, images=str(tmp_path / "elsewhere")).test[0].photo is not None
    linked = blender(tmp_path / "blender")
    (linked / "train").rename(tmp_path / "moved")
    (linked / "train").symlink_to(tmp_path / "moved")
    refused(linked, "; where a link leads there, copy it, or link the whole data set")


def test_folder_of_photos_must_exist_and_hold_some(tmp_path):
    colmap_bin(tmp_path)
    missing = "there is no folder .*: relative paths start at the cameras' folder"
    for said in (missing, "holds no photo of these cameras"):
        with pytest.raises(UsageError, match=said):
            read_cameras(tmp_path, images="images_4")
        (tmp_path / "images_4").mkdir(exist_ok=True)


# Blender and nerfstudio -------------------------------------------------------------------------

OPENGL = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]


def transforms(frames, **shared):
    frames = [{"transform_matrix": OPENGL} | frame for frame in frames]
    return {"camera_angle_x": math.pi / 2} | shared | {"frames": frames}


def plain_transforms(folder):
    return write_json(folder / "transforms.json", transforms([{"file_path": "a"}], w=40, h=20))


def blender(folder):
    for split, count in (("train", 3), ("test", 2), ("val", 1)):
        frames = [{"file_path": f"./{split}/r_{i}"} for i in range(count)]
        write_json(folder / f"transforms_{split}.json", transforms(frames))
        photo(folder / split / "r_0.png", 40, 20, "RGBA")
    return folder


def test_blender_values(tmp_path):
    cameras = read_cameras(blender(tmp_path))
    assert (names(cameras.train), names(cameras.test)) == (["r_0", "r_1", "r_2"], ["r_0", "r_1"])
    camera = cameras.train[0]
    assert (camera.hw, camera.cx, camera.cy) == ((20, 40), 20, 10)
    assert camera.fx == camera.fy == pytest.approx(20)  # 90° over 40 px
    assert (camera.photo, cameras.train[1].photo) == (tmp_path / "train" / "r_0.png", None)
    assert cameras.background == WHITE
    assert camera.centre.tolist() == [1, 2, 3]
    # the camera looks along its own -z, so along the world's -z; its up is -x of the world
    ahead = torch.tensor([1.0, 2.0, 0.0, 1.0], dtype=torch.float64)
    above = torch.tensor([0.0, 2.0, 3.0, 1.0], dtype=torch.float64)
    assert (camera.cam_from_world @ ahead).tolist() == [0, 0, 3, 1]
    assert (camera.cam_from_world @ above).tolist() == [0, -1, 0, 1]
    assert any("transforms_val.json" in note for note in cameras.notes)
    camera = read_cameras(tmp_path, train_scale=0.25).test[0]
    assert (camera.hw, camera.trained_focal, camera.fx) == ((5, 10), camera.focal, pytest.approx(5))


@pytest.mark.parametrize(
    ("suffix", "mode"), [("png", "RGBA"), ("png", "LA"), ("png", "P"), ("webp", "RGBA"), ("png", "RGB")]
)
def test_photos_with_any_kind_of_alpha_are_on_white(tmp_path, suffix, mode):
    clear = {"transparency": 0} if mode == "P" else {}
    Image.new(mode, (40, 20)).save(tmp_path / f"a.{suffix}", **clear)
    path = write_json(tmp_path / "transforms.json", transforms([{"file_path": "a"}]))
    assert read_cameras(path).background == (None if mode == "RGB" else WHITE)


def test_blender_split_is_not_overruled(tmp_path):
    with pytest.raises(UsageError, match="gives the split"):
        read_cameras(blender(tmp_path), test_every=8)
    one = read_cameras(tmp_path / "transforms_test.json")
    assert one.train is one.test
    (tmp_path / "transforms_test.json").unlink()
    assert names(read_cameras(tmp_path).test) == ["r_0", "r_1", "r_2"]


def test_transforms_intrinsics_of_a_frame_come_first(tmp_path):
    shared = {"w": 40, "h": 20.0, "fl_x": 30, "fl_y": 31, "cx": 19, "cy": 9, "k1": 0}
    frames = [{"file_path": "a/1.png"}, {"file_path": "b/1.png", "fl_x": 50, "w": 60}]
    path = write_json(tmp_path / "transforms.json", transforms(frames, **shared))
    first, second = read_cameras(tmp_path).train
    assert (first.name, *values(first), first.hw) == ("a/1", 30, 31, 19, 9, (20, 40))
    assert (second.name, second.fx, second.fy, second.hw) == ("b/1", 50, 31, (20, 60))
    assert read_cameras(path, test_every=2).test[0].name == "a/1"
    photo(tmp_path / "b" / "1.png", 60, 20)
    twice = transforms([{"file_path": "b/1.png"}, {"file_path": "./b/1"}], **shared)
    refused(write_json(path, twice), "names should be unique, but 'b/1.png' is there twice")


@pytest.mark.parametrize(
    ("lens", "focals"),
    [
        ({"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, (20, 10)),
        ({"camera_angle_x": math.pi / 2}, (20, 20)),
        ({"camera_angle_y": math.pi / 2}, (10, 10)),
        ({"camera_angle_x": 1.0, "camera_angle_y": math.pi / 2, "fl_x": 30}, (30, 10)),
        ({"camera_angle_x": 1.0, "camera_angle_y": 1.0, "fl_x": 30, "fl_y": 31}, (30, 31)),
    ],
    ids=str,
)
def test_each_axis_of_transforms_has_its_focal_length_or_angle(tmp_path, lens, focals):
    """Where one has neither, it has the other's focal length, as in instant-ngp."""
    document = transforms([{"file_path": "a"} | lens], w=40, h=20)
    del document["camera_angle_x"]
    (camera,) = read_cameras(write_json(tmp_path / "transforms.json", document | {"w": 40, "h": 20})).train
    assert (camera.fx, camera.fy) == pytest.approx(focals)


@pytest.mark.parametrize("make", [colmap_bin, blender])
def test_a_folder_of_photos_that_may_not_be_looked_into_is_refused(tmp_path, monkeypatch, make):
    make(tmp_path)
    looked = os.stat

    def denied(path, **how):
        if isinstance(path, Path) and path.parent.name in ("images", "train"):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
        return looked(path, **how)

    monkeypatch.setattr(os, "stat", denied)
    refused(tmp_path, "cannot be looked into: permission denied")


def test_what_is_not_read_beside_the_cameras_is_told(tmp_path):
    frames = [{"file_path": r"images\a.png", "mask_path": "masks/a.png"}]
    photo(tmp_path / "images" / "a.png", 3000, 10)
    path = write_json(tmp_path / "transforms.json", transforms(frames, w=3000, h=10))
    cameras = read_cameras(tmp_path)
    assert cameras.train[0].photo == tmp_path / "images" / "a.png"
    for said in ("masks are not read", "nerfstudio halves larger ones: `train_scale` sets it"):
        assert any(said in note for note in cameras.notes)
    told = "".join(read_cameras(path, train_scale=0.5).notes[:-1])
    assert "train_scale" not in told.replace("0.5: `train_scale`", "")
    colmap_bin(tmp_path / "sparse" / "0")
    colmap_bin(tmp_path / "sparse" / "1")
    (tmp_path / "masks").mkdir()
    (tmp_path / "images_4").mkdir()
    (tmp_path / "test_list.txt").touch()
    (tmp_path / "sparse" / "0" / "test.txt").touch()
    cameras = read_cameras(tmp_path)
    for said in (
        "masks are not read",
        "photos: images holds none of these cameras' (a.b.png); `images` names another folder, such as",
        "other models beside 0, not read: 1",
        "other cameras in the folder, not read: transforms.json (nerfstudio, instant-ngp)",
    ):
        assert any(said in note for note in cameras.notes), said
    assert "lists of views, not read: test_list.txt, test.txt" in cameras.notes


@pytest.mark.parametrize(
    ("lens", "name", "coefficients"),
    [
        ({"k1": -0.1, "p2": 0.01, "camera_model": "OPENCV"}, "OPENCV", (-0.1, 0, 0, 0.01, 0)),
        ({"k1": -0.1, "k3": 0.2}, "PINHOLE", (-0.1, 0, 0, 0, 0.2)),
        ({"k4": 0.1, "camera_model": "OPENCV"}, "OPENCV", None),  # nerfstudio's own
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.1}, "OPENCV_FISHEYE", (0, 0, 0, 0.1)),
        ({"camera_model": "SIMPLE_RADIAL", "k1": -0.1}, "SIMPLE_RADIAL", (-0.1, 0, 0, 0, 0)),  # a k1 to nerfstudio
        ({"is_fisheye": True}, "fisheye", (0, 0, 0, 0)),
        ({"camera_model": "ORTHOPHOTO"}, "ORTHOPHOTO", None),
    ],
    ids=str,
)
def test_a_lens_that_distorts_is_the_pinhole_at_its_centre(tmp_path, lens, name, coefficients):
    photo(tmp_path / "a.png", 40, 20)
    frames = [{"file_path": "a.png"} | lens, {"file_path": "b.png"}]
    document = transforms(frames, w=40, h=20, fl_x=30, cx=19, cy=9)
    file = write_json(tmp_path / "transforms.json", document)
    cameras = read_cameras(file, undistort=True)
    first, straight = cameras.train
    assert f"1 camera with another lens than a pinhole ({name})" in cameras.notes[-1]
    assert (straight.lens, straight.undistortion) == (PINHOLE, None)
    bent = read_cameras(file).train[0]
    if coefficients is None:
        assert (first.fx, first.cx, first.photo, first.undistortion) == (30, 19, None, None)
        assert (bent.photo, bent.lens) == (None, PINHOLE)
    else:
        assert first.undistortion is not None
        left = first.undistortion.window[0]
        assert (first.fx, first.cx + left, first.photo) == (30, 19, tmp_path / "a.png")
        lens = opencv_lens(tuple(map(float, coefficients)), "fisheye" in name.lower())
        assert first.undistortion.lens == bent.lens == lens
        assert (bent.fx, bent.cx, bent.photo) == (30, 19, tmp_path / "a.png")
    (tmp_path / "a.png").unlink()  # the lens is drawn without its photograph, too
    assert ("drawn as pinholes" in read_cameras(file).notes[-1]) == (coefficients is None)


EXPORTED = {"file_path": "/elsewhere/a.png", "fl_x": 30.0, "fl_y": 31.0, "w": 40, "h": 20}
EXPORTED |= {"transform": [[1.0, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3]]}


def test_an_exported_list_is_in_the_trained_frame(tmp_path):
    """nerfstudio's `ns-export cameras`; what the file of the dataparser says is in its poses already."""
    move = {"transform": [[1.0, 0, 0, 5], [0, 1, 0, 5], [0, 0, 1, 5]], "scale": 2.0}
    write_json(tmp_path / "dataparser_transforms.json", move)
    path = write_json(tmp_path / "transforms_train.json", [EXPORTED])
    for source in (path, tmp_path):
        cameras = read_cameras(source)
        (camera,) = cameras.train
        assert (camera.name, camera.photo, camera.fx, camera.fy) == ("a", None, 30, 31)
        assert (camera.width, camera.cx, camera.centre.tolist()) == (40, 20, [1, 2, 3])
        assert camera.cam_from_world[:3, :3].diagonal().tolist() == [1, -1, -1]
        assert "ns-export cameras" in cameras.notes[-1]


def test_nerfstudios_lists_are_the_split(tmp_path):
    frames = [{"file_path": f"{c}.png"} for c in "abc"]
    for lists, train, test in [
        ({"train_filenames": ["a.png", "c.png"], "test_filenames": ["b.png"]}, ["a", "c"], ["b"]),
        ({"train_filenames": ["./a.png", ".\\c.png"]}, ["a", "c"], ["b"]),
        ({"train_filenames": ["a.png"], "test_filenames": []}, ["a"], ["b", "c"]),
        ({"test_filenames": ["b.png"]}, ["a", "c"], ["b"]),
        ({"test_frames": [{"transform_matrix": OPENGL, "file_path": "d.png"}]}, ["a", "b", "c"], ["d"]),  # ScanNet++
    ]:
        path = write_json(tmp_path / "transforms.json", transforms(frames, w=40, h=20, **lists))
        cameras = read_cameras(path)
        assert (names(cameras.train), names(cameras.test)) == (train, test)
        assert "test_frames" in lists or len(read_cameras(path, test_every=0).train) == 3


def test_the_dataparsers_transform_takes_poses_to_the_trained_frame(tmp_path):
    frames = [{"file_path": "a.png"}]
    document = transforms(frames, w=40, h=20, applied_transform=[[1, 0, 0, 0]])
    path = write_json(tmp_path / "transforms.json", document)
    before = read_cameras(path)
    assert "dataparser_transforms.json" in before.notes[-1]
    turn = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]]
    write_json(tmp_path / "dataparser_transforms.json", {"transform": turn, "scale": 0.5})
    after = read_cameras(path)
    matrix = torch.tensor(turn, dtype=torch.float64)
    point = torch.tensor([0.3, -0.7, 0.2, 1.0], dtype=torch.float64)
    moved = torch.cat([0.5 * (matrix @ point), point[3:]])
    first, second = (c.train[0].cam_from_world @ p for c, p in ((before, point), (after, moved)))
    torch.testing.assert_close(second[:3], 0.5 * first[:3])  # the same picture, at half the size
    for wrong in ({"transform": turn, "scale": 0}, {"transform": [[1]], "scale": 1}, [], {}):
        write_json(tmp_path / "dataparser_transforms.json", wrong)
        refused(path, "dataparser_transforms")


# Plain pinholes ---------------------------------------------------------------------------------


def pinhole(**changes):
    motion = [[0, 1, 0, 4], [-1, 0, 0, 5], [0, 0, 1, 6], [0, 0, 0, 1]]
    sizes = {"width": 40, "height": 20, "fx": 30, "fy": 31, "cx": 19, "cy": 9}
    return sizes | {"world_to_camera": motion} | changes


def test_pinhole_values(tmp_path):
    (camera,) = read_cameras(write_json(tmp_path / "cam_40.json", pinhole())).train
    assert camera.cam_from_world.tolist() == pinhole()["world_to_camera"]
    assert (camera.name, *values(camera), camera.hw) == ("cam_40", 30, 31, 19, 9, (20, 40))
    views = read_cameras(write_json(tmp_path / "list.json", [pinhole()] * 11), test_every=5)
    assert names(views.test) == ["camera_00", "camera_05", "camera_10"]


def test_names_have_slashes_on_windows_too(tmp_path, monkeypatch):
    folders = ("left", "right")
    for folder in folders:
        photo(tmp_path / folder / "a.png", 40, 20)
    frames = [{"file_path": f"{folder}/a.png"} for folder in folders]
    file = write_json(tmp_path / "transforms.json", transforms(frames, w=40, h=20))
    relative = Path.relative_to
    monkeypatch.setattr(Path, "relative_to", lambda *each: PureWindowsPath(relative(*each)))
    assert names(read_cameras(file).all) == ["left/a", "right/a"]


# Camera paths, LLFF, multi-scale Blender ---------------------------------------------------------


def twin(folder):
    """The same camera in a transforms.json."""
    return read_cameras(plain_transforms(folder)).train[0]


def llff(folder, count=9):
    """The camera of the transforms above, in LLFF's axes: down, right, back."""
    opengl = np.array(OPENGL)[:3]
    right, up, back, centre = opengl.T
    matrix = np.stack([-up, right, back, centre, [20.0, 40.0, 30.0]], axis=1)
    folder.mkdir(exist_ok=True)
    np.save(folder / "poses_bounds.npy", np.tile(np.append(matrix.ravel(), [1, 9]), (count, 1)))
    return folder


def test_llff_axes_are_down_right_and_back(tmp_path):
    cameras = read_cameras(llff(tmp_path))
    camera = cameras.train[0]
    assert torch.allclose(camera.cam_from_world, twin(tmp_path / "other").cam_from_world, atol=1e-15)
    assert (camera.fx, camera.hw, camera.name) == (30, (20, 40), "001")
    assert names(cameras.test) == ["000", "008"]
    for i in range(9):
        photo(tmp_path / "images" / f"IMG_{i}.JPG", 20, 10)
        (tmp_path / "images" / f"._IMG_{i}.JPG").write_bytes(b"macOS's")
    camera = read_cameras(tmp_path / "poses_bounds.npy").train[0]
    assert (camera.name, camera.fx, camera.hw) == ("IMG_1", 15, (10, 20))
    header = (tmp_path / "poses_bounds.npy").read_bytes().replace(b"(9, 17)", b"(999999999, 17)")
    (tmp_path / "poses_bounds.npy").write_bytes(header)
    refused(tmp_path, "not a .npy file")


def multiscale(folder):
    row = {"file_path": ["train/r_0.png", "train/r_0_d1.png"], "cam2world": [OPENGL] * 2, "label": [0, 1]}
    row |= {"width": [40, 20], "height": [20, 10], "focal": [30.0, 15.0]}
    test = {key: values[:1] for key, values in row.items()}
    return write_json(folder / "metadata.json", {"train": row, "val": test, "test": test})


def test_multiscale_blender_has_a_view_a_scale(tmp_path):
    cameras = read_cameras(multiscale(tmp_path).parent)
    assert names(cameras.train) == ["r_0", "r_0_d1"]
    assert [(c.fx, c.hw, c.trained_focal) for c in cameras.train] == [(30, (20, 40), 30), (15, (10, 20), 15)]
    assert (len(cameras.test), cameras.background) == (1, WHITE)
    assert "val in metadata.json is not read" in cameras.notes
    with pytest.raises(UsageError, match="gives the split"):
        read_cameras(tmp_path, test_every=8)


# SHARP -----------------------------------------------------------------------------------------


def sharp(folder, order="<", text=False, **tables):
    """A scene with the tables of SHARP's camera, or with others instead."""
    values = {"extrinsic": TURNED, "intrinsic": [300, 0, 21, 0, 310, 14, 0, 0, 1], "image_size": [40, 30]} | tables
    write_scene(folder / "plain.ply", make_scene(9), overwrite=True)
    elements = [PlyData.read(folder / "plain.ply")["vertex"]]
    for name, column in values.items():
        kind = "u4" if name == "image_size" else "f4"
        elements.append(PlyElement.describe(np.array(column).astype([(name, kind)]), name))
    PlyData(elements, text=text, byte_order=order).write(folder / "photo.ply")
    return folder / "photo.ply"


@pytest.mark.parametrize("order", "<>")
def test_the_camera_of_a_sharp_file_is_that_of_its_photograph(tmp_path, order):
    path = sharp(tmp_path, order)
    (camera,) = read_cameras(path).all
    assert (camera.name, *values(camera), camera.hw) == ("photo", 300, 310, 21, 14, (30, 40))
    assert (camera.cam_from_world.flatten().tolist(), camera.trained_focal) == (TURNED, camera.focal)
    assert read_cameras(path, train_scale=0.5).all[0].hw == (15, 20)
    scene = aaplug.read_scene(path)
    assert (scene.convention, scene.cameras) == (KHR, read_cameras(path))
    aaplug.write_scene(tmp_path / "again.ply", scene.gaussians())
    assert aaplug.read_scene(tmp_path / "again.ply").cameras is not None


def test_tables_of_another_kind_are_no_camera(tmp_path):
    for tables in ({"text": True}, {"intrinsic": [300, 310, 40, 30]}, {"image_size": [40, 30, 3]}):
        scene = aaplug.read_scene(sharp(tmp_path, **tables))
        assert (scene.convention, scene.cameras) == (CLASSIC, None)


# Choosing ---------------------------------------------------------------------------------------


def test_a_folder_is_read_as_the_most_telling_of_its_formats(tmp_path):
    for make, kind in (
        (plain_transforms, "transforms"),
        (inria, "INRIA"),
        (blender, "transforms"),
        (lambda folder: colmap_bin(folder / "sparse" / "0"), "COLMAP"),
        (lambda folder: inria(folder, cfg="Namespace()"), "INRIA"),
    ):
        make(tmp_path)
        assert read_cameras(tmp_path).notes[0].split()[0] == kind


def test_a_folder_without_cameras_says_what_was_looked_for(tmp_path):
    refused(tmp_path, "cameras.json", "COLMAP", "transforms_train.json")
    refused(tmp_path / "none", "no such file")


@pytest.mark.parametrize(
    "options", [{"train_scale": 0.0}, {"train_scale": math.nan}, {"train_scale": 1e9}, {"test_every": 1}], ids=str
)
def test_odd_options_are_refused(tmp_path, options):
    with pytest.raises(UsageError):
        read_cameras(inria(tmp_path), **options)


def test_views_are_chosen_by_split_or_name(tmp_path):
    cameras = read_cameras(inria(tmp_path, *many(17), cfg="Namespace(eval=True)"))
    assert select_views(cameras, "train") == cameras.train
    assert select_views(cameras, "test") == cameras.test
    assert len(select_views(cameras, "all")) == 17
    assert names(select_views(cameras, "v08, v01,v08,v01.jpg,")) == ["v08", "v01"], "a photograph's name is its view's"
    with pytest.raises(UsageError, match=r"views: there is no view 'v1'.*v1"):
        select_views(cameras, "v01,v1")
    with pytest.raises(UsageError):
        select_views(cameras, "")
    for none in ("test", "all"):
        with pytest.raises(UsageError, match=f"views: {none} has no views"):
            select_views(CameraSet(cameras.train if none == "test" else (), ()), none)
    both = read_cameras(blender(tmp_path / "blender"))
    assert select_views(both, "r_0") == (both.test[0],), "a name in both splits is the test view"


# Hostile bytes ----------------------------------------------------------------------------------


FIXTURES = {  # how to make each format's files, the path to read, and the file to spoil
    "inria": (lambda folder: inria(folder, cfg="Namespace(eval=True)"), "cameras.json"),
    "inria_model": (lambda folder: inria(folder, cfg="Namespace(eval=True)"), "cfg_args"),
    "colmap": (colmap_bin, "cameras.bin"),
    "images.bin": (colmap_bin, "images.bin"),
    "cameras.txt": (colmap_txt, "cameras.txt"),
    "images.txt": (colmap_txt, "images.txt"),
    "blender": (blender, "transforms_train.json"),
    "transforms": (lambda folder: plain_transforms(folder).parent, "transforms.json"),
    "pinhole": (lambda folder: write_json(folder / "p.json", pinhole()), ""),
    "camera_path": (lambda folder: write_json(folder / "path.json", document()), ""),
    "llff": (llff, "poses_bounds.npy"),
    "multiscale": (lambda folder: multiscale(folder).parent, "metadata.json"),
    "sharp": (sharp, ""),
}


@pytest.mark.parametrize("name", [format.name for format in OWN])
def test_each_format_is_recognized_and_no_other_takes_its_files(tmp_path, name):
    path = FIXTURES[name][0](tmp_path / "set") if name != "inria" else inria(tmp_path / "set")
    takers = [format.name for format in OWN if format.sniff(path)]
    assert takers == ([name, "inria"] if name == "inria_model" else [name])
    cameras = read_cameras(str(path))
    assert cameras.all
    assert name != "camera_path" or cameras.notes[0].startswith("camera path: 1 free camera, ")


def write_text(path, text):
    path.write_text(text, encoding="latin-1")
    return path


def write_transforms(folder, frame, **shared):
    return write_json(folder / "transforms.json", transforms([{"file_path": "a"} | frame], **shared))


def write_multiscale(path, change):
    return write_json(path, with_value(json.loads(path.read_text()), ("train", change[0]), change[1]))


SPOIL = {  # how to make a file of cameras with something changed
    "cfg_args": lambda folder, text: inria(folder, cfg=text),
    "text": lambda folder, text: write_text(folder / "cameras.json", text),
    "inria": lambda folder, change: inria(folder, inria_entry(), inria_entry("b") | change),
    "cameras.txt": lambda folder, text: write_text(colmap_txt(folder) / "cameras.txt", text).parent,
    "image": lambda folder, image: colmap_bin(folder, images=(image,)),
    "frame": lambda folder, change: write_transforms(folder, change, w=40, h=20),
    "transforms": lambda folder, shared: write_transforms(folder, {}, **shared),
    "exported": lambda folder, entry: write_json(folder / "transforms_train.json", [entry]),
    "llff": lambda folder, rows: np.save(folder / "poses_bounds.npy", rows) or folder,
    "multiscale": lambda folder, change: write_multiscale(multiscale(folder), change),
    "sharp": lambda folder, tables: sharp(folder, **tables),
}
AT = (0.0, 0.0, 0.0)
UNTURNED = (1.0, 0.0, 0.0, 0.0)
CFG_ARGS = [
    *("1", "print(1)", "Namespace(1)", "Namespace(**{'resolution': 1})", "Namespace(x=1); import os"),
    *("Namespace(resolution=0)", "Namespace(resolution='4')", "Namespace(eval=1)", "Namespace(x=f'{1}')"),
    *("Namespace(images='../secret')", f"Namespace(x={'-' * 5000}1)", f"Namespace(x='{'y' * 70000}')"),
]
TEXTS = ["", "{}", "[]", "[1]", "[" * 100_000, '[{"id": Infinity}]', '[{"width": ' + "9" * 5000 + "}]", "\xff"]
LLFF = [
    *(np.zeros(shape) for shape in ((2, 16), 17, (0, 17), (2, 17))),
    *(np.ones((2, 17), int), np.array([{}] * 17)[None]),
]
MULTISCALE = [("file_path", ["../x", "y"]), ("cam2world", None), ("width", []), ("height", [1]), ("focal", [1e999, 1])]
SIDES = {"w": 40, "h": 20}
PLACES = {"inria": "cameras.json", "sharp": "photo.ply: its camera"}  # which each message of a kind names
WRONG = [
    *(("cfg_args", text, "cfg_args") for text in CFG_ARGS),
    *(("text", text, "cameras") for text in TEXTS),
    ("inria", {"fx": 0}, "camera 1: fx should be from 1e-06 to 1e+09 px, not 0"),
    ("inria", {"fx": True}, "camera 1: fx should be a number, not True"),
    ("inria", {"fx": 10**400}, "camera 1: fx should be a finite number"),
    ("inria", {"width": 0}, "camera 1: width should be a whole number of px from 1 to 65536, not 0"),
    ("inria", {"position": [1, 2]}, "camera 1: position should be 3 numbers"),
    ("inria", {"rotation": [[1, 0, 0], [0, 1, 0]]}, "rotation should be 3 rows of 3 numbers"),
    ("inria", {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, "R·Rᵀ is 3 off the identity"),
    ("inria", {"rotation": [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]}, "it mirrors"),
    ("inria", {"img_name": "../a"}, "path '../a' should stay within the dataset"),
    ("inria", {"img_name": "C:\\a"}, "should stay within the dataset"),
    ("inria", {"img_name": "\ud800"}, "img_name should be printable text"),
    ("cameras.txt", "1 EQUIRECTANGULAR 400 200 0 200\n7 EQUIRECTANGULAR 400 200 0 200", "parameter should be"),
    ("image", (1, (0.0, 0, 0, 0), AT, 1, "a"), "image 1: quaternion should be finite"),
    ("image", (1, UNTURNED, (math.inf, 0, 0), 1, "a"), "translation should be a finite number"),
    ("image", (1, UNTURNED, AT, 9, "a"), "uses camera 9"),
    ("image", (1, UNTURNED, AT, 1, "../a"), "should stay within the dataset"),
    ("image", (1, UNTURNED, AT, 1, "a\nb"), "name should be printable"),
    ("image", (1, UNTURNED, AT, 1, "n" * 5000), "should end within 4096 bytes"),
    ("transforms", {}, "add w and h"),
    ("frame", {"k1": "a"}, "frame 0: k1 should be a number"),
    ("frame", {"distortion_params": 3}, "distortion_params should be a list"),
    ("frame", {"camera_model": "VR180_L"}, "camera_model is VR180_L, which has no focal length"),
    ("frame", {"camera_angle_x": 3.2}, "camera_angle_x should be above 0 and below π"),
    ("frame", {"file_path": "../x"}, "should stay within the dataset"),
    ("frame", {"transform_matrix": OPENGL[:3]}, "transform_matrix should be 4 rows of 4 numbers"),
    ("frame", {"transform_matrix": [*OPENGL[:3], [0, 0, 0, 2]]}, "last row should be 0 0 0 1"),
    ("transforms", SIDES | {"test_frames": [{"file_path": "d.png"}]}, "test frame 0: transform_matrix is missing"),
    ("transforms", SIDES | {"train_filenames": "a.png"}, "train_filenames should be a list"),
    ("transforms", SIDES | {"val_filenames": ["b.jpg"]}, "val_filenames should be paths of frames, not 'b.jpg'"),
    ("exported", {key: EXPORTED[key] for key in EXPORTED if key != "fl_x"}, "give nerfstudio's transforms.json"),
    ("exported", {"file_path": "a.png"}, "item 0 should be an object with file_path and transform"),
    ("exported", EXPORTED | {"transform": 3}, "transform_matrix should be"),
    ("exported", {key: EXPORTED[key] for key in EXPORTED if key != "file_path"}, "file_path is missing"),
    *(("llff", rows, "poses_bounds.npy") for rows in LLFF),
    *(("multiscale", change, "metadata.json") for change in MULTISCALE),
    ("sharp", {"intrinsic": [300, 1, 21, 0, 310, 14, 0, 0, 1]}, "intrinsic should be [[fx 0 cx]"),
    ("sharp", {"intrinsic": [-3, 0, 21, 0, 310, 14, 0, 0, 1]}, "intrinsic should be from 1e-06"),
    ("sharp", {"intrinsic": [300, 0, math.nan, 0, 310, 14, 0, 0, 1]}, "intrinsic should be a finite number, not nan"),
    ("sharp", {"image_size": [0, 30]}, "image_size should be a whole number of px"),
    ("sharp", {"extrinsic": [2.0, *TURNED[1:]]}, "extrinsic should be a rotation"),
    ("sharp", {"extrinsic": [*TURNED[:15], 2.0]}, "extrinsic's last row should be 0 0 0 1"),
]


@pytest.mark.parametrize(("kind", "change", "message"), WRONG, ids=range(len(WRONG)))
def test_a_file_of_cameras_names_what_is_wrong(tmp_path, kind, change, message):
    refused(SPOIL[kind](tmp_path, change), PLACES.get(kind, ""), message)


@dataclass(frozen=True)
class Dialect:
    """A plug-in that reads transforms.json in its own way."""

    name: str = "dialect"
    sign: str = "a dialect"
    change: Mapping[str, Any] = field(default_factory=dict)

    def sniff(self, path: Path) -> bool:
        return path.name == "transforms.json"

    def read(self, path: Path, options: CameraFileOptions) -> CameraSet:
        cameras = (replace(make_camera(), **self.change),)
        return CameraSet(cameras, cameras, notes=("by the plug-in",))


def with_formats(monkeypatch, *formats):
    registry = Registry("camera format", "aaplug.io.cameras:CameraFormat", named(formats))
    monkeypatch.setattr("aaplug.io.cameras.CAMERA_FORMATS", registry)


def test_a_plug_in_is_asked_before_the_own_formats(tmp_path, monkeypatch):
    with_formats(monkeypatch, *OWN, Dialect())
    path = plain_transforms(tmp_path)
    assert read_cameras(path).notes == ("by the plug-in",)
    assert read_cameras(tmp_path).notes != ("by the plug-in",)


FAR_AWAY = torch.eye(4, dtype=torch.float64)
FAR_AWAY[0, 3] = 1e300


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": math.nan}, "camera view: fx: expected a number above 0"),
        ({"height": 0}, "camera view: height: expected an integer from 1"),
        ({"cy": math.inf}, "camera view: cy: expected a number"),
        ({"cam_from_world": 2 * torch.eye(4, dtype=torch.float64)}, "camera view: cam_from_world: expected a rotation"),
        ({"cam_from_world": FAR_AWAY}, "camera view: cam_from_world: expected a translation of at most 1e"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_what_a_plug_in_reads_is_checked(tmp_path, monkeypatch, change, message):
    with_formats(monkeypatch, Dialect(change=change))
    refused(write_json(tmp_path / "transforms.json", {}), message)


# Real scenes ------------------------------------------------------------------------------------


@pytest.mark.data
def test_one_scene_has_the_same_poses_in_all_its_formats(shared_data):
    folder = shared_data / "snowmiku"
    colmap = read_cameras(folder)
    assert (len(colmap.train), len(colmap.test)) == (84, 13)
    expected = {camera.name: camera for camera in colmap.all}
    for name in ("cameras.json", "transforms.json"):
        cameras = read_cameras(folder / name).all
        assert {camera.name for camera in cameras} == set(expected)
        for camera in cameras:
            twin = expected[camera.name]
            assert torch.allclose(camera.cam_from_world, twin.cam_from_world, rtol=0, atol=1e-6)
            assert (camera.hw, camera.photo) == (twin.hw, twin.photo)
            assert (camera.fx, camera.cx) == pytest.approx((twin.fx, twin.cx), abs=1e-6)


@pytest.mark.data
def test_test_views_by_name_are_those_that_3dgs_lists_first(shared_data):
    folders = sorted((shared_data / "formats" / "inria").rglob("original_3dgs_train/*"))
    folder = min(folders, key=lambda folder: (folder / "cameras.json").stat().st_size)
    listed = [without_suffix(entry["img_name"]) for entry in json.loads((folder / "cameras.json").read_text())]
    cameras = read_cameras(folder)
    assert names(cameras.test) == listed[: len(cameras.test)]
