"""`transforms*.json`: Blender's (NeRF-synthetic), and nerfstudio's where it describes pinholes.

frames: [{file_path, transform_matrix}].  transform_matrix: camera-to-world, OpenGL axes (x right, y
up, z backward), world units.  The focal length is fl_x and fl_y, in px, or comes from
camera_angle_x, the full angle in radians; w, h, cx, cy are in px.  Keys beside `frames` hold for
every frame that has none of its own.  Without w and h the photos give the size.  Paths are relative
to the file.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from aaplug.cameras import WHITE, Camera, CameraSet
from aaplug.errors import FormatError, UsageError
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
from aaplug.io.values import (
    Entry,
    distortion_refusal,
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
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV")  # OPENCV is one as long as it does not distort
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
OPENCV_FROM_OPENGL = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)  # y and z change sign
LEAST_ANGLE = 1e-9  # rad: less is no view
PNG = b"\x89PNG\r\n\x1a\n"
PNG_COLOUR_TYPE = 25  # byte of the header
PNG_ALPHA = (4, 6)  # colour types with alpha: grey and colour


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
    sources = [_cameras(path / name, options) for name in (TRAIN, TEST)]
    train, test = (_trained(source, options) for source in sources)
    split = explicit(train, test, f"{TRAIN} and {TEST}")
    return _with_note(_cameras_set([*sources[0], *sources[1]], split, options), _ignored(path))


def read(path: Path, options: Options) -> CameraSet:
    """The cameras of one file.

    Raises:
        FormatError: the file is not what it should be.
        UsageError: the options do not fit.
    """
    file = path / ALONE if os.path.isdir(path) else path
    source = _cameras(file, options)
    trained = _trained(source, options)
    if options.test_every:
        trained = sorted(trained, key=lambda camera: camera.name)
    return _cameras_set(source, every_nth(trained, options, 0, f"only {file.name} read"), options)


def _cameras_set(source: Sequence[Camera], split: Split, options: Options) -> CameraSet:
    scale = options.train_scale
    why = "size in the files" if scale is None else f"size in the files × {scale:g}: --train-scale"
    alpha = any(camera.photo and _has_alpha(camera.photo) for camera in source)
    notes = (
        f"transforms JSON: {len(source)} cameras, {described_sizes(source)} in the files",
        split.note,
        f"training size: {described_sizes([*split.train, *split.test])} ({why})",
        *(["background: white, Blender's custom, as photos have alpha"] if alpha else []),
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


def _cameras(file: Path, options: Options) -> list[Camera]:
    """The file's cameras at the size that the file or the photos give."""
    refuse_folder(options.images)
    frames = _frames(file)
    paths = [frame.entry.text("file_path") for frame in frames]
    names = distinct(file, paths, (last_part, without_suffix, whole))
    spare = _spare_size(frames)
    return [_camera(frame, name, spare) for frame, name in zip(frames, names, strict=True)]


def _frames(file: Path) -> list[Frame]:
    document = read_json(file)
    if not isinstance(document, dict) or "frames" not in document:
        raise FormatError(
            file, "should be an object with 'frames', as Blender and nerfstudio write"
        )
    shared = {key: value for key, value in document.items() if key != "frames"}
    folder = PhotoFolder(file.parent, file.parent)
    return [
        Frame(entry, folder.find(entry.text("file_path"), entry.place))
        for entry in entries(file, "frame", document["frames"], shared)
    ]


def _spare_size(frames: Sequence[Frame]) -> Size | None:
    """The size of the first photo, for frames that have none."""
    photo = next((frame.photo for frame in frames if frame.photo), None)
    return image_size(photo) if photo else None


def _camera(frame: Frame, name: str, spare: Size | None) -> Camera:
    entry = frame.entry
    _refuse_distortion(entry)
    width, height = _size(frame, spare)
    fx = _focal(entry, width)
    motion = rigid(entry, "transform_matrix")
    world_from_cam = pose(
        motion[:3, :3] * OPENCV_FROM_OPENGL, motion[:3, 3], entry.place, "transform_matrix"
    )
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


def _refuse_distortion(entry: Entry) -> None:
    model = entry.text("camera_model") if "camera_model" in entry else PINHOLES[0]
    if model not in PINHOLES:
        raise distortion_refusal(entry.place, f"its camera_model is {model}")
    if entry.fields.get("is_fisheye"):
        raise distortion_refusal(entry.place, "is_fisheye is set")
    bent = [key for key in DISTORTION if key in entry and entry.number(key)]
    if bent:
        raise distortion_refusal(entry.place, f"{bent[0]} is {entry.number(bent[0]):g}")
    parameters = entry.fields.get("distortion_params") or []
    if not isinstance(parameters, list) or any(
        number(value, entry.place, "distortion_params") for value in parameters
    ):
        raise distortion_refusal(entry.place, "distortion_params are not zero")


def _has_alpha(photo: Path) -> bool:
    try:
        with photo.open("rb") as file:
            header = file.read(PNG_COLOUR_TYPE + 1)
    except OSError as error:
        raise FormatError(photo, f"cannot be read: {error.strerror}") from error
    return header.startswith(PNG) and header[PNG_COLOUR_TYPE:] in [bytes([t]) for t in PNG_ALPHA]
