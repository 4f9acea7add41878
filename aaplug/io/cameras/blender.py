"""`transforms*.json`: Blender's (NeRF-synthetic), and nerfstudio's where it describes pinholes.

frames: [{file_path, transform_matrix}].  transform_matrix: camera-to-world, OpenGL axes (x right, y
up, z backward), world units.  A file dataparser_transforms.json beside it takes poses to the frame in
which nerfstudio trained.  The focal length is fl_x and fl_y, in px, or comes from
camera_angle_x, the full angle in radians; w, h, cx, cy are in px.  Keys beside `frames` hold for
every frame that has none of its own.  Without w and h the photos give the size.  Paths are relative
to the file.  `ns-export cameras` writes a bare list of {file_path, transform: 3×4} in the trained frame, which is read
where its entries tell of the lens.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from aaplug.core.cameras import WHITE, Camera, CameraSet
from aaplug.core.errors import FormatError, UsageError
from aaplug.io.cameras.dataparser import DATAPARSER, Dataparser, read_dataparser
from aaplug.io.cameras.options import Options, Split, every_nth, explicit
from aaplug.io.cameras.photos import (
    PhotoFolder,
    Size,
    described_sizes,
    distinct,
    last_part,
    refuse_folder,
    scaled_sizes,
    trained_at,
    whole,
    without_suffix,
)
from aaplug.io.images import image_size
from aaplug.io.lenses import Distortion, lens_notes, straightened
from aaplug.io.values import (
    Entry,
    Place,
    entries,
    focal,
    inverse,
    mentions,
    number,
    pose,
    read_json,
    rigid,
)

ALONE, TRAIN, TEST, VAL = (f"transforms{part}.json" for part in ("", "_train", "_test", "_val"))
AROUND = (
    "EQUIRECTANGULAR",
    "OMNIDIRECTIONALSTEREO_L",
    "OMNIDIRECTIONALSTEREO_R",
    "VR180_L",
    "VR180_R",
)
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")  # OPENCV is one as long as it does not distort
EXPORTED = "transform"  # a frame's pose, 3×4, where nerfstudio exported it
LAST_ROW = [0.0, 0.0, 0.0, 1.0]
FISHEYE = "OPENCV_FISHEYE"
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
OPENCV_FROM_OPENGL = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)  # y and z change sign
LEAST_ANGLE = 1e-9  # rad: less is no view
SPLITS = ("train_filenames", "val_filenames", "test_filenames")  # nerfstudio's lists
PNG = b"\x89PNG\r\n\x1a\n"
PNG_COLOUR_TYPE = 25  # byte of the header
PNG_ALPHA = (4, 6)  # colour types with alpha: grey and colour


@dataclass(frozen=True)
class Source:
    """A file's cameras as it describes them.  held_out: which of them are test views, None if it does not say."""

    cameras: tuple[Camera, ...]
    held_out: tuple[bool, ...] | None = None
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Frame:
    """A frame and its photo, if there is one."""

    entry: Entry
    photo: Path | None


def sniff_split(path: Path) -> bool:
    """Whether a folder holds Blender's training views."""
    return os.path.isfile(path / TRAIN)


def sniff(path: Path) -> bool:
    """Whether a folder holds transforms.json, or a file is one by name or by its keys."""
    if os.path.isdir(path):
        return os.path.isfile(path / ALONE)
    named = path.name.startswith("transforms") and path.suffix == ".json"
    return named or mentions(path, ["transform_matrix", "frames"])


def read_split(path: Path, options: Options) -> CameraSet:
    """The cameras of a folder, split as its files say.

    Raises:
        FormatError: a file is not what it should be.
        UsageError: the options do not fit.
    """
    if not os.path.isfile(path / TEST):
        return _with_note(read(path / TRAIN, options), _ignored(path))
    if options.test_every is not None:
        raise UsageError("--test-every", f"{path / TEST} gives the split; leave the option out")
    train, test = (_source(path / name, options) for name in (TRAIN, TEST))
    split = explicit(
        _trained(train.cameras, options), _trained(test.cameras, options), f"{TRAIN} and {TEST}"
    )
    both = Source(
        (*train.cameras, *test.cameras), notes=tuple({**dict.fromkeys(train.notes + test.notes)})
    )
    return _with_note(_cameras_set(both, split, options), _ignored(path))


def read(path: Path, options: Options) -> CameraSet:
    """The cameras of one file.

    Raises:
        FormatError: the file is not what it should be.
        UsageError: the options do not fit.
    """
    file = path / ALONE if os.path.isdir(path) else path
    source = _source(file, options)
    trained = _trained(source.cameras, options)
    if source.held_out is not None and options.test_every is None:
        pairs = list(zip(trained, source.held_out, strict=True))
        split = explicit(
            [c for c, out in pairs if not out],
            [c for c, out in pairs if out],
            "lists of file names",
        )
        return _cameras_set(source, split, options)
    if options.test_every:
        trained = sorted(trained, key=lambda camera: camera.name)
    return _cameras_set(source, every_nth(trained, options, 0, f"only {file.name} read"), options)


def _cameras_set(read: Source, split: Split, options: Options) -> CameraSet:
    source = read.cameras
    scale = options.train_scale
    why = "size in the files" if scale is None else f"size in the files × {scale:g}: --train-scale"
    alpha = any(camera.photo and _has_alpha(camera.photo) for camera in source)
    notes = (
        f"transforms JSON: {len(source)} cameras, {described_sizes(source)} in the files",
        split.note,
        f"training size: {described_sizes([*split.train, *split.test])} ({why})",
        *(["background: white, Blender's custom, as photos have alpha"] if alpha else []),
        *read.notes,
    )
    return CameraSet(split.train, split.test, WHITE if alpha else None, notes)


def _with_note(cameras: CameraSet, note: str | None) -> CameraSet:
    if note is None:
        return cameras
    return CameraSet(cameras.train, cameras.test, cameras.background, (*cameras.notes, note))


def _ignored(folder: Path) -> str | None:
    return f"{VAL} is not read" if os.path.isfile(folder / VAL) else None


def _trained(source: Sequence[Camera], options: Options) -> list[Camera]:
    scale = 1.0 if options.train_scale is None else options.train_scale
    return trained_at(source, scaled_sizes(source, scale))


def _source(file: Path, options: Options) -> Source:
    """The file's cameras at the size that the file or the photos give, in the frame of the trained scene."""
    refuse_folder(options.images)
    document = _document(file)
    frames = _frames(file, document)
    paths = [frame.entry.text("file_path") for frame in frames]
    names = distinct(file, paths, (last_part, without_suffix, whole))
    spare = _spare_size(frames)
    exported = any(EXPORTED in frame.entry for frame in frames)
    parser = None if exported else read_dataparser(file.parent / DATAPARSER)
    cameras = [
        _camera(frame, name, spare, parser) for frame, name in zip(frames, names, strict=True)
    ]
    bent = [_bent(frame.entry) for frame in frames]
    cameras = straightened(cameras, bent)
    notes = lens_notes(bent, cameras)
    if exported:
        notes.append("frame: that in which nerfstudio trained (ns-export cameras); photos unknown")
    elif parser:
        notes.append(
            f"frame: that of {DATAPARSER} (scale {parser.scale:g}), in which nerfstudio trains"
        )
    elif "applied_transform" in document:
        notes.append(
            f"frame: as in the file; a scene that nerfstudio trained needs its {DATAPARSER} beside it"
        )
    return Source(tuple(cameras), _held_out(file, document, paths), tuple(notes))


def _held_out(
    file: Path, document: dict[str, Any], paths: Sequence[str]
) -> tuple[bool, ...] | None:
    """Which frames nerfstudio's lists of file names keep from training, if there are lists."""
    place = Place(file, "lists of file names")
    lists = {key: document[key] for key in SPLITS if key in document}
    if SPLITS[0] not in lists:
        return None
    for key, listed in lists.items():
        if not isinstance(listed, list) or not all(isinstance(p, str) for p in listed):
            raise place.wrong(key, "a list of paths", listed)
    train = set(lists[SPLITS[0]])
    return tuple(path not in train for path in paths)


def _document(file: Path) -> dict[str, Any]:
    document = read_json(file)
    if isinstance(document, list):
        return {"frames": [_exported(file, index, row) for index, row in enumerate(document)]}
    if not isinstance(document, dict) or "frames" not in document:
        raise FormatError(
            file, "should be an object with 'frames', as Blender and nerfstudio write"
        )
    return document


def _exported(file: Path, index: int, row: object) -> dict[str, Any]:
    """A frame of `ns-export cameras`: its pose has three rows; where photos lay when it was written is no matter."""
    if not isinstance(row, dict) or EXPORTED not in row:
        raise FormatError(
            file, f"item {index} should be an object with file_path and transform, as ns-export cameras writes"
        )  # fmt: skip
    if not {"fl_x", "w", "h"} <= row.keys():
        raise FormatError(
            file,
            f"item {index} has no fl_x, w and h, so that its lens is unknown; give nerfstudio's transforms.json, "
            f"with the run's {DATAPARSER} beside it",
        )
    rows = row[EXPORTED]
    return {**row, "transform_matrix": [*rows, LAST_ROW] if isinstance(rows, list) else rows}


def _frames(file: Path, document: dict[str, Any]) -> list[Frame]:
    shared = {key: value for key, value in document.items() if key != "frames"}
    folder = PhotoFolder(file.parent, file.parent)
    found = entries(file, "frame", document["frames"], shared)
    return [
        Frame(
            entry, None if EXPORTED in entry else folder.find(entry.text("file_path"), entry.place)
        )
        for entry in found
    ]


def _spare_size(frames: Sequence[Frame]) -> Size | None:
    """The size of the first photo, for frames that have none."""
    photo = next((frame.photo for frame in frames if frame.photo), None)
    return image_size(photo) if photo else None


def _camera(frame: Frame, name: str, spare: Size | None, parser: Dataparser | None) -> Camera:
    entry = frame.entry
    width, height = _size(frame, spare)
    fx = _focal(entry, width)
    motion = rigid(entry, "transform_matrix")
    world_from_cam = pose(
        motion[:3, :3] * OPENCV_FROM_OPENGL, motion[:3, 3], entry.place, "transform_matrix"
    )
    world_from_cam = world_from_cam if parser is None else parser.moved(world_from_cam)
    return Camera(
        name,
        width,
        height,
        fx,
        entry.focal("fl_y") if "fl_y" in entry else fx,
        entry.number("cx") if "cx" in entry else width / 2,
        entry.number("cy") if "cy" in entry else height / 2,
        inverse(world_from_cam, entry.place, "transform_matrix"),
        photo=frame.photo,
    )


def _size(frame: Frame, spare: Size | None) -> Size:
    entry = frame.entry
    if "w" in entry and "h" in entry:
        return entry.pixels("w"), entry.pixels("h")
    if frame.photo:
        return image_size(frame.photo)
    if spare is None:
        raise entry.place.error(
            "its size is unknown: the file has no w and h and there are no photos; "
            "put the photos where file_path says, or add w and h (px) beside frames"
        )
    return spare


def _focal(entry: Entry, width: int) -> float:
    if "fl_x" in entry or "camera_angle_x" not in entry:
        return entry.focal("fl_x")
    angle = entry.number("camera_angle_x")
    if not LEAST_ANGLE <= angle < math.pi:
        raise entry.place.wrong("camera_angle_x", "above 0 and below π, in radians", angle)
    return focal(width / 2 / math.tan(angle / 2), entry.place, "camera_angle_x's focal length")


def _bent(entry: Entry) -> Distortion | None:
    """The distortion, if the lens is more than a pinhole."""
    model = entry.text("camera_model") if "camera_model" in entry else PINHOLES[0]
    if model in AROUND:
        raise entry.place.error(f"its camera_model is {model}, which has no focal length")
    k = {key: entry.number(key) if key in entry else 0.0 for key in DISTORTION}
    listed = entry.fields.get("distortion_params") or []
    if not isinstance(listed, list):
        raise entry.place.wrong("distortion_params", "a list of numbers", listed)
    others = [number(value, entry.place, "distortion_params") for value in listed]
    others += [k["k5"], k["k6"]]
    if entry.fields.get("is_fisheye") or model == FISHEYE:
        name = model if model == FISHEYE else "fisheye"
        angular = tuple(k[key] for key in ("k1", "k2", "k3", "k4"))
        return Distortion(name, None if any(others) else angular, fisheye=True)
    if model in PINHOLES and not any(others) and not any(k.values()):
        return None
    known = model in PINHOLES and not any(others) and not k["k4"]
    radial = tuple(k[key] for key in ("k1", "k2", "p1", "p2", "k3"))  # in OpenCV's order
    return Distortion(model, radial if known else None)


def _has_alpha(photo: Path) -> bool:
    try:
        with photo.open("rb") as file:
            header = file.read(PNG_COLOUR_TYPE + 1)
    except OSError as error:
        raise FormatError(photo, f"cannot be read: {error.strerror}") from error
    return header.startswith(PNG) and header[PNG_COLOUR_TYPE:] in [bytes([t]) for t in PNG_ALPHA]
