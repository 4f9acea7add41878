"""COLMAP datasets.

The root holds `images`, and a model in `sparse/0` or `sparse`: cameras (intrinsics) and images (poses), both .bin or
both .txt.  Poses are world-to-camera, OpenCV axes, in world units; the centre of the first pixel is (0.5, 0.5); focal
lengths and principal points are in px.  A camera keeps its lens, as far as `core.lenses` has it.  Points are not read.
"""

import os
from dataclasses import replace
from pathlib import Path

import torch

from aaplug.core.cameras import Camera, CameraSet, rigid_motion
from aaplug.core.projection import rotation_matrices
from aaplug.io.cameras import sets
from aaplug.io.cameras.colmap_files import KINDS, Image, Intrinsics, read_cameras, read_images
from aaplug.io.cameras.photos import distinct, photo_folder, without_suffix
from aaplug.io.cameras.poses import pose
from aaplug.io.cameras.sets import CameraFileOptions
from aaplug.io.lenses import PANORAMA, Distortion, panorama, with_lenses
from aaplug.io.values import Place, focal, number, pixels, unit
from aaplug.system.errors import FormatError, listing

SPLIT_LISTS = ("train_list.txt", "test_list.txt", "test.txt")  # nerfbaselines' and 3DGS's

name = "colmap"
sign = "sparse/0 or sparse (COLMAP)"


def sniff(path: Path) -> bool:
    """True for a dataset's root, a model's folder, and one of a model's files."""
    return _model_folder(path) is not None


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras at the size of their photos."""
    folder = _model_folder(path) or path
    pairs = [(folder / f"cameras{kind}", folder / f"images{kind}") for kind in KINDS]
    pair = next((pair for pair in pairs if all(map(os.path.isfile, pair))), None)
    if pair is None:
        needs = "a COLMAP model needs cameras.bin and images.bin, or cameras.txt and images.txt"
        there = listing([file.name for pair in pairs for file in pair if os.path.isfile(file)])
        raise FormatError(folder, f"{needs}; found {there or 'neither'}")
    cameras_file, images_file = pair
    intrinsics = read_cameras(cameras_file)
    images = sorted(read_images(images_file), key=lambda image: image.name)
    root = folder.absolute()
    if root.name.isdigit() and "sparse" in root.parent.name:
        root = root.parent
    root = root.parent if "sparse" in root.name else root
    photos = photo_folder(root, options, "images", Place(folder, "images"))
    source = [_camera(image, intrinsics, photos.find(image.name, image.place)) for image in images]
    photos.check(source)
    folders = dict.fromkeys((root, folder.absolute()))
    lists = [name for each in folders for name in SPLIT_LISTS if os.path.isfile(each / name)]
    unread = [f"lists of views, not read: {', '.join(lists)}"] if lists else []
    models = {file.parent.name for kind in KINDS for file in folder.parent.glob(f"[0-9]*/images{kind}")}
    others = sorted(models - {folder.name}) if folder.name.isdigit() else []  # parts that COLMAP could not join
    beside = [f"other models beside {folder.name}, not read: {listing(others)}"] if others else []
    more = [*photos.notes(source), *beside, *unread]
    names = distinct(images_file, [image.name for image in images], (without_suffix, str))
    source = [replace(camera, name=name) for camera, name in zip(source, names, strict=True)]
    trained, why = sets.at_photo_size(source, options)
    lenses = [_distortion(intrinsics[image.camera_id]) for image in images]
    trained, lens_notes = with_lenses(trained, lenses, options.undistort)
    split = sets.every_nth(trained, options, sets.LLFF_HOLD, "3DGS --eval's rule; `test_every` 0 for no split")
    kind = f"COLMAP ({images_file.suffix[1:]})"
    return sets.camera_set(kind, source, split, why, more=more + lens_notes)


def _model_folder(path: Path) -> Path | None:
    if not os.path.isdir(path):
        in_model = path.stem in ("cameras", "images", "points3D") and path.suffix in KINDS
        return path.parent if in_model else None
    tries = (path / "sparse" / "0", path / "sparse", path / "0", path)
    return next((t for t in tries if any(os.path.isfile(t / f"cameras{k}") for k in KINDS)), None)


def _camera(image: Image, intrinsics: dict[int, Intrinsics], photo: Path | None) -> Camera:
    if image.camera_id not in intrinsics:
        raise image.place.error(f"uses camera {image.camera_id}, which cameras does not hold")
    lens = intrinsics[image.camera_id]
    values, n = [number(value, lens.place, "parameter") for value in lens.parameters], lens.model.focals
    if lens.model.name == PANORAMA:
        fx, fy, cx, cy = panorama(*(pixels(side, lens.place, "parameter") for side in values))
    else:
        fx, fy = (focal(f, lens.place, "focal length") for f in (values[0], values[n - 1]))
        cx, cy = values[n : n + 2]
    width, height = pixels(lens.width, lens.place, "width"), pixels(lens.height, lens.place, "height")
    translation = [number(value, image.place, "translation") for value in image.translation]
    quats = unit(torch.tensor([image.quaternion], dtype=torch.float64), image.place, "quaternion")
    turn = rotation_matrices(quats)[0]
    cam_from_world = pose(rigid_motion(turn, torch.tensor(translation, dtype=torch.float64)), image.place, "quaternion")
    return Camera(image.name, width, height, fx, fy, cx, cy, cam_from_world, photo=photo)


def _distortion(lens: Intrinsics) -> Distortion | None:
    """The distortion, None for a pinhole."""
    rest = lens.parameters[lens.model.focals + 2 :]
    if lens.model.straight and not any(rest):
        return None
    values, lens_of = tuple(number(value, lens.place, "parameter") for value in rest), lens.model.lens
    return Distortion(lens.model.name, lens_of(values) if lens_of else None)
