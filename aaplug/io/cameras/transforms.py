"""`transforms*.json` of Blender (NeRF-synthetic), instant-ngp and nerfstudio.

frames: [{file_path, transform_matrix}].  transform_matrix: camera-to-world, OpenGL axes, world units.  The focal length
of an axis is fl_x or fl_y, in px, or follows from camera_angle_x or camera_angle_y, the full angle in radians; an axis
without either has that of the other.  w, h, cx, cy are in px.
Keys beside `frames` are defaults for all frames.  Without w and h, the photos give the size.  Paths are relative to the
file.  nerfstudio's dataparser_transforms.json, {transform: 3×4, scale}, beside the file maps poses to the frame of the
trained scene: with the rotation R and the translation t, a point p becomes scale · (R p + t).
`ns-export cameras` writes a bare list of {file_path, transform: 3×4} in the trained frame, which is read if its entries
have fl_x, w and h.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.colours import WHITE
from aaplug.core.lenses import EQUIRECT, opencv_lens
from aaplug.io.cameras import sets
from aaplug.io.cameras.photos import MASKED, PhotoFolder, distinct, last_part, without_suffix
from aaplug.io.cameras.poses import inverse, pose, rigid
from aaplug.io.cameras.sets import CameraFileOptions, Size
from aaplug.io.images import image_size, is_transparent
from aaplug.io.lenses import PANORAMA, Distortion, panorama, with_lenses
from aaplug.io.values import Entry, Place, entries, focal, mentions, number, object_of, pixels, read_json, text
from aaplug.system.errors import FormatError, UsageError

FILE = "transforms.json"
TRAIN, TEST, VAL = (f"transforms_{split}.json" for split in ("train", "test", "val"))
STEREO = ("OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R", "VR180_L", "VR180_R")
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")  # if the coefficients are 0
EXPORTED = "transform"  # key of a frame's 3×4 pose in `ns-export cameras`
FISHEYE = "OPENCV_FISHEYE"
OPENCV_ORDER = ("k1", "k2", "p1", "p2", "k3")
COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
MIN_ANGLE = 1e-9  # rad: the smallest angle of view
TEST_FRAMES = "test_frames"  # ScanNet++'s split
FILE_LISTS = ("train_filenames", "val_filenames", "test_filenames")  # nerfstudio's split
MASK = "mask_path"
DATAPARSER = "dataparser_transforms.json"

Dataparser = tuple[Float[Tensor, "4 4"], float]  # a rigid motion, followed by a scale

name = "transforms"
sign = "transforms.json (nerfstudio, instant-ngp)"


def sniff(path: Path) -> bool:
    """True for a folder that holds transforms.json, and for a file that is one by its name or keys."""
    if os.path.isdir(path):
        return os.path.isfile(path / FILE)
    named = path.name.startswith("transforms") and path.suffix == ".json"
    return named or mentions(path, ["transform_matrix", "frames"])


def read(path: Path, options: CameraFileOptions) -> CameraSet:
    """The cameras of one file."""
    return _set([path / FILE if os.path.isdir(path) else path], options)


class Blender:
    """A Blender (NeRF-synthetic) dataset: a folder with `transforms_train.json` and `transforms_test.json`."""

    name = "blender"
    sign = "transforms_train.json (Blender)"

    @staticmethod
    def sniff(path: Path) -> bool:
        """True for a folder with training views."""
        return os.path.isfile(path / TRAIN)

    @staticmethod
    def read(path: Path, options: CameraFileOptions) -> CameraSet:
        """The cameras, with the split that the files give."""
        files = [path / TRAIN, *filter(os.path.isfile, [path / TEST])]
        if len(files) > 1 and options.test_every is not None:
            raise UsageError("test_every", f"{path / TEST} gives the split; leave it out")
        cameras = _set(files, options)
        more = (f"{VAL} is not read",) if os.path.isfile(path / VAL) else ()
        return replace(cameras, notes=cameras.notes + more)


def _set(files: Sequence[Path], options: CameraFileOptions) -> CameraSet:
    """The cameras of one file, or of one with training and one with test views.

    Photos with alpha mean a white background, Blender's custom.
    """
    (source, held_out, notes), *test = (_source(file, options) for file in files)
    reason = f"lists in {files[0].name}" if held_out else f"only {files[0].name} read"
    for more, _, others in test:
        held_out, reason = [False] * len(source) + [True] * len(more), f"{TRAIN} and {TEST}"
        source, notes = [*source, *more], list(dict.fromkeys(notes + others))
    cameras, why = sets.at_file_size(source, options)
    if held_out is not None and options.test_every is None:
        pairs = list(zip(cameras, held_out, strict=True))
        train, held = ([camera for camera, out in pairs if out == is_held] for is_held in (False, True))
        split = sets.explicit(train, held, reason)
    else:
        cameras = sorted(cameras, key=lambda camera: camera.name) if options.test_every else cameras
        split = sets.every_nth(cameras, options, 0, reason)
    alpha = any(is_transparent(camera.photo) for camera in source if camera.photo)
    more = ["background: white, Blender's custom, as photos have alpha"] if alpha else []
    return sets.camera_set("transforms JSON", source, split, why, WHITE if alpha else None, [*more, *notes])


def _source(file: Path, options: CameraFileOptions) -> tuple[list[Camera], list[bool] | None, list[str]]:
    """The cameras at the size that the file or the photos give, in the frame of the trained scene; and notes.

    Between them: true for each that is a test view, None if the file does not say.
    """
    document = _document(file)
    shared = {key: value for key, value in document.items() if key != "frames"}
    frames = entries(file, "frame", document["frames"], shared)
    if document.get(TEST_FRAMES):
        frames += entries(file, "test frame", document[TEST_FRAMES], shared)
    exported = any(EXPORTED in frame for frame in frames)
    folder = PhotoFolder(file.parent, file.parent)
    paths = [_plain(frame.get("file_path", text)) for frame in frames]
    photos = [None if EXPORTED in f else folder.find(path, f.place) for f, path in zip(frames, paths, strict=True)]
    found = [
        photo.relative_to(file.parent).as_posix() if photo else path for path, photo in zip(paths, photos, strict=True)
    ]
    names = distinct(file, found, (last_part, without_suffix, str))
    photo = next(filter(None, photos), None)
    spare = image_size(photo) if photo else None  # for frames without w, h and photo
    parser, beside = None, file.parent / DATAPARSER
    if not exported and os.path.isfile(beside):
        about = object_of(read_json(beside), beside, "it", "transform and scale")
        matrix, scale = about.matrix("transform", 3, 4), about.get("scale", number)
        about.place.expect(scale > 0, "scale", "above 0", scale)
        parser = pose(matrix, about.place, "transform"), scale
    cameras = [_camera(*each, spare, parser) for each in zip(frames, photos, names, strict=True)]
    cameras, notes = with_lenses(cameras, [_distortion(frame) for frame in frames], options.undistort)
    if exported:
        notes.append("frame: that in which nerfstudio trained (ns-export cameras); photos unknown")
    elif parser:
        notes.append(f"frame: that of {DATAPARSER} (scale {parser[1]:g}), in which nerfstudio trains")
    elif "applied_transform" in document:
        notes.append(f"frame: as in the file; a scene that nerfstudio trained needs its {DATAPARSER} beside it")
    if any(MASK in frame for frame in frames):
        notes.append(MASKED)
    return cameras, _held_out(file, document, paths), notes


def _document(file: Path) -> dict[str, Any]:
    """The object with `frames`; those of `ns-export cameras`, whose pose has three rows, get the fourth."""
    document = read_json(file)
    if not isinstance(document, list):
        return object_of(document, file, "it", "'frames', as Blender and nerfstudio write", "frames").fields
    frames = []
    for index, row in enumerate(document):
        if not isinstance(row, dict) or EXPORTED not in row:
            what = "an object with file_path and transform, as ns-export cameras writes"
            raise FormatError(file, f"item {index} should be {what}")
        if not {"fl_x", "w", "h"} <= row.keys():
            lacks = f"item {index} has no fl_x, w and h, so its lens is unknown"
            hint = f"give nerfstudio's transforms.json, with the run's {DATAPARSER} beside it"
            raise FormatError(file, f"{lacks}; {hint}")
        rows = row[EXPORTED]
        frames.append({**row, "transform_matrix": [*rows, [0.0, 0.0, 0.0, 1.0]] if isinstance(rows, list) else rows})
    return {"frames": frames}


def _held_out(file: Path, document: dict[str, Any], paths: Sequence[str]) -> list[bool] | None:
    """True for each frame that lists of file names or of frames keep from training; None without lists."""
    lists, frames = dict[str, set[str]](), set(paths)
    place = Place(file, "lists of file names")
    for key in filter(document.__contains__, FILE_LISTS):
        listed = document[key]
        right = isinstance(listed, list) and all(isinstance(path, str) for path in listed)
        place.expect(right, key, "a list of paths", listed)
        for path in listed:
            place.expect(_plain(path) in frames, key, "paths of frames", path)
        lists[key] = set(map(_plain, listed))
    if not lists:
        training = len(document["frames"])
        return [i >= training for i in range(len(paths))] if len(paths) > training else None
    train = lists.get(FILE_LISTS[0], frames.difference(*lists.values()))
    return [path not in train for path in paths]


def _plain(path: str) -> str:
    """A path with slashes between its parts, as Windows' programs may not write it, and without `.`."""
    return str(PurePosixPath(path.replace("\\", "/")))


def _camera(entry: Entry, photo: Path | None, name: str, spare: Size | None, parser: Dataparser | None) -> Camera:
    if "w" in entry and "h" in entry:
        width, height = entry.get("w", pixels), entry.get("h", pixels)
    elif size := image_size(photo) if photo else spare:
        width, height = size
    else:
        unknown = "its size is unknown: the file has no w and h, and there are no photos"
        raise entry.place.error(f"{unknown}; put the photos where file_path says, or add w and h (px) beside frames")
    if entry.get("camera_model", text, PINHOLES[0]) == PANORAMA:
        fx, fy, cx, cy = panorama(width, height)
    else:
        fx, fy = _focal(entry, "x", width), _focal(entry, "y", height)
        fx = fx or fy or entry.get("fl_x", focal)  # which is missing
        fy, cx, cy = fy or fx, entry.get("cx", number, width / 2), entry.get("cy", number, height / 2)
    world_from_cam = rigid(entry, "transform_matrix", opengl=True)
    if parser is not None:
        world_from_cam = parser[0] @ world_from_cam
        world_from_cam[:3, 3] *= parser[1]
    return Camera(name, width, height, fx, fy, cx, cy, inverse(world_from_cam), photo=photo)


def _focal(entry: Entry, axis: str, side: int) -> float | None:
    """The focal length of an axis, in px, None if the file gives neither it nor the angle of view."""
    length, field = f"fl_{axis}", f"camera_angle_{axis}"
    if length in entry or field not in entry:
        return entry.get(length, focal) if length in entry else None
    angle = entry.get(field, number)
    entry.place.expect(MIN_ANGLE <= angle < math.pi, field, "above 0 and below π, in radians", angle)
    return focal(side / 2 / math.tan(angle / 2), entry.place, f"{field}'s focal length")


def _distortion(entry: Entry) -> Distortion | None:
    """The distortion, None for a pinhole."""
    model = entry.get("camera_model", text, PINHOLES[0])
    if model == PANORAMA:
        return Distortion(model, EQUIRECT)
    if model in STEREO:
        raise entry.place.error(f"its camera_model is {model}, which has no focal length")
    k = {key: entry.get(key, number, 0.0) for key in COEFFICIENTS}
    listed = entry.fields.get("distortion_params") or []
    entry.place.expect(isinstance(listed, list), "distortion_params", "a list of numbers", listed)
    others = [number(value, entry.place, "distortion_params") for value in listed]
    others += [k["k5"], k["k6"]]
    if entry.fields.get("is_fisheye") or model == FISHEYE:
        angular = opencv_lens(tuple(k[key] for key in ("k1", "k2", "k3", "k4")), fisheye=True)
        return Distortion(model if model == FISHEYE else "fisheye", None if any(others) else angular)
    if model in PINHOLES and not any(others) and not any(k.values()):
        return None
    supported = model in PINHOLES and not any(others) and not k["k4"]
    return Distortion(model, opencv_lens(tuple(k[key] for key in OPENCV_ORDER)) if supported else None)
