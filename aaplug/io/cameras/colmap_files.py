"""The records of COLMAP's model files, binary and text, unchecked.

cameras: id, model, size in px, parameters (focal lengths, principal point, distortion; px).
images: id, world-to-camera pose as quaternion wxyz and translation, camera id, name; their points are skipped.

Functions raise FormatError for a file that breaks its format.
"""

import os
import re
import struct
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, TypeVar

from aaplug.core.lenses import EQUIRECT, Lens, opencv_lens
from aaplug.io.lenses import PANORAMA
from aaplug.io.limits import whole_limit
from aaplug.io.values import Place, text
from aaplug.system.errors import FormatError, reason

Record = TypeVar("Record")
Number = TypeVar("Number", int, float)
Parser = Callable[[Path, BinaryIO], Iterator[Record]]

KINDS = (".bin", ".txt")
MAX_LINE_SIZE = 64 * 2**20  # bytes: a line lists the points of one image
POINT_SIZE = 24  # bytes: x, y (float64) and the 3D point's id
COUNT_RECORD = struct.Struct("<Q")
CAMERA_RECORD = struct.Struct("<IiQQ")  # id, model, width, height; the parameters follow
IMAGE_RECORD = struct.Struct("<I7dI")  # id, quaternion, translation, camera id; name and points follow
MIN_CAMERA_SIZE = CAMERA_RECORD.size + 2 * 8  # bytes: every model has 2 parameters or more
MIN_IMAGE_SIZE = IMAGE_RECORD.size + 1 + COUNT_RECORD.size  # bytes: an empty name has its NUL
CAMERA_FIELDS = 4  # id, model, width, height
NUMBER = re.compile(rb"[-+.\deE]+")
IMAGE_FIELDS = 10  # id, 4 of the quaternion, 3 of the translation, camera id, name


class Model(NamedTuple):
    """One of COLMAP's camera models.

    parameters: how many.
    focals: how many of them are focal lengths, which come first; cx and cy follow, then distortion.
    straight: true if it is a pinhole when all distortion is zero.
    lens: called with the distortion's parameters; None for a model that `Lens` lacks.
    """

    name: str
    parameters: int
    focals: int
    straight: bool
    lens: Callable[[tuple[float, ...]], Lens] | None = None


def _thin_prism_fisheye(coefficients: tuple[float, ...]) -> Lens:
    k1, k2, p1, p2, k3, k4, sx1, sy1 = coefficients
    return Lens("equidistant", (k1, k2, k3, k4), tangential=(p1, p2), prism=(sx1, 0.0, sy1, 0.0))


_fisheye = partial(opencv_lens, fisheye=True)
MODELS = (  # by COLMAP's model id
    Model("SIMPLE_PINHOLE", 3, 1, True),
    Model("PINHOLE", 4, 2, True),
    Model("SIMPLE_RADIAL", 4, 1, True, opencv_lens),
    Model("RADIAL", 5, 1, True, opencv_lens),
    Model("OPENCV", 8, 2, True, opencv_lens),
    Model("OPENCV_FISHEYE", 8, 2, False, _fisheye),
    Model("FULL_OPENCV", 12, 2, True, opencv_lens),
    Model("FOV", 5, 2, True),
    Model("SIMPLE_RADIAL_FISHEYE", 4, 1, False, _fisheye),
    Model("RADIAL_FISHEYE", 5, 1, False, _fisheye),
    Model("THIN_PRISM_FISHEYE", 12, 2, False, _thin_prism_fisheye),
    Model("RAD_TAN_THIN_PRISM_FISHEYE", 16, 2, False),
    Model("SIMPLE_DIVISION", 4, 1, True),
    Model("DIVISION", 5, 2, True),
    Model("SIMPLE_FISHEYE", 3, 1, False, _fisheye),
    Model("FISHEYE", 4, 2, False, _fisheye),
    Model("EUCM", 6, 2, False),
    Model(PANORAMA, 2, 0, False, lambda _: EQUIRECT),
)
MODEL_NAMES = {model.name: model for model in MODELS}


class Intrinsics(NamedTuple):
    """A camera as its file has it; values are checked when an image uses it."""

    place: Place
    key: int
    model: Model
    width: int
    height: int
    parameters: tuple[float, ...]


class Image(NamedTuple):
    """An image as its file has it."""

    place: Place
    name: str
    camera_id: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]


def read_cameras(file: Path) -> dict[int, Intrinsics]:
    """Read the intrinsics, by camera id."""
    by_id: dict[int, Intrinsics] = {}
    for intrinsics in _records(file, _binary_cameras, _text_cameras):
        if intrinsics.key in by_id:
            raise intrinsics.place.error("ids should be unique, but this one is there twice")
        by_id[intrinsics.key] = intrinsics
    return by_id


def read_images(file: Path) -> list[Image]:
    """Read the images, in the order of the file."""
    images = list(_records(file, _binary_images, _text_images))
    if not images:
        raise FormatError(file, "holds no image: the reconstruction placed no camera")
    return images


def _unpacked(file: Path, stream: BinaryIO, record: struct.Struct, what: str) -> tuple[Any, ...]:
    """One record of fixed size."""
    data = stream.read(record.size)
    if len(data) < record.size:
        raise FormatError(file, f"{what}: {record.size} bytes expected, {len(data)} left; the file is cut short")
    return record.unpack(data)


def _count(file: Path, stream: BinaryIO, least: int, what: str) -> int:
    """A number of records, checked against the bytes that are left, `least` or more for each."""
    (n,) = _unpacked(file, stream, COUNT_RECORD, f"number of {what}")
    left = os.fstat(stream.fileno()).st_size - stream.tell()
    if n * least > left:
        need = f"{n} {what} need {n * least} bytes at least, and {left} are left"
        raise FormatError(file, f"{need}; the file is cut short or is not COLMAP's")
    return n


def _records(file: Path, binary: Parser[Record], lines: Parser[Record]) -> Iterator[Record]:
    try:
        with file.open("rb") as stream:
            yield from (binary if file.suffix == KINDS[0] else lines)(file, stream)
    except OSError as error:
        raise FormatError(file, f"cannot be read: {reason(error)}") from error


def _binary_cameras(file: Path, stream: BinaryIO) -> Iterator[Intrinsics]:
    for index in range(_count(file, stream, MIN_CAMERA_SIZE, "cameras")):
        what = f"camera record {index}"
        key, model_id, width, height = _unpacked(file, stream, CAMERA_RECORD, what)
        place = Place(file, f"camera {key}")
        if not 0 <= model_id < len(MODELS):
            raise place.wrong("model", f"COLMAP's, 0 to {len(MODELS) - 1}", model_id)
        model = MODELS[model_id]
        parameters = _unpacked(file, stream, struct.Struct(f"<{model.parameters}d"), what)
        yield Intrinsics(place, key, model, width, height, parameters)


def _binary_images(file: Path, stream: BinaryIO) -> Iterator[Image]:
    for index in range(_count(file, stream, MIN_IMAGE_SIZE, "images")):
        what = f"image record {index}"
        key, *motion, camera_id = _unpacked(file, stream, IMAGE_RECORD, what)
        place = Place(file, f"image {key}")
        start, most = stream.tell(), whole_limit("NAME")
        chunk = stream.read(most + 1)
        name, end, _ = chunk.partition(b"\0")
        if not end:
            raise FormatError(file, f"{what}: its name should end within {most} bytes, not after {len(chunk)}")
        stream.seek(start + len(name) + 1)
        stream.seek(_count(file, stream, POINT_SIZE, f"points of {what}") * POINT_SIZE, os.SEEK_CUR)
        yield Image(place, text(_decoded(name, place), place, "name"), camera_id, tuple(motion[:4]), tuple(motion[4:]))


def _text_cameras(file: Path, stream: BinaryIO) -> Iterator[Intrinsics]:
    for row, line in _lines(file, stream):
        fields = _decoded(line, Place(file, f"line {row}")).split()
        if not fields or fields[0].startswith("#"):
            continue
        place = Place(file, f"camera {fields[0][:20]!s} in line {row}")
        if len(fields) < CAMERA_FIELDS:
            raise place.wrong("it", "id, model, width, height and parameters", " ".join(fields))
        if (model := MODEL_NAMES.get(fields[1])) is None:
            raise place.wrong("model", "one of COLMAP's", fields[1])
        key, width, height = (_parsed(int, fields[i], place) for i in (0, 2, 3))
        parameters = tuple(_parsed(float, field, place) for field in fields[CAMERA_FIELDS:])
        if len(parameters) != model.parameters:
            raise place.wrong("it", f"{model.name} with {model.parameters} parameters", f"{len(parameters)} of them")
        yield Intrinsics(place, key, model, width, height, parameters)


def _text_images(file: Path, stream: BinaryIO) -> Iterator[Image]:
    lines = _lines(file, stream)
    for row, line in lines:
        if not line.strip() or line.lstrip().startswith(b"#"):
            continue
        place = Place(file, f"image in line {row}")
        fields = _decoded(line, place).split(maxsplit=IMAGE_FIELDS - 1)
        if len(fields) != IMAGE_FIELDS:
            raise place.wrong("it", "id, quaternion, translation, camera id and name", line)
        motion = tuple(_parsed(float, field, place) for field in fields[1:8])
        name = text(fields[-1].strip(), place, "name")
        yield Image(place, name, _parsed(int, fields[8], place), motion[:4], motion[4:])
        row, points = next(lines, (row, b""))  # of the image, an empty line if there are none
        several = points.split(maxsplit=IMAGE_FIELDS)  # of as many as an image has it is seen that they are points
        whole = len(several) > IMAGE_FIELDS or len(several) % 3 == 0
        right, what = whole and all(map(NUMBER.fullmatch, several[:IMAGE_FIELDS])), "X Y POINT3D_ID each, or empty"
        Place(file, f"line {row}").expect(right, "it", f"the points of the image above, {what}", points)


def _lines(file: Path, stream: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Numbered lines of bounded length."""
    for row, line in enumerate(iter(lambda: stream.readline(MAX_LINE_SIZE + 1), b""), start=1):
        if len(line) > MAX_LINE_SIZE:
            raise FormatError(file, f"line {row} is longer than {MAX_LINE_SIZE} bytes")
        yield row, line


def _decoded(line: bytes, place: Place) -> str:
    try:
        return line.decode()
    except UnicodeDecodeError as error:
        raise place.wrong("it", "UTF-8", line) from error


def _parsed(kind: Callable[[str], Number], field: str, place: Place) -> Number:
    try:
        return kind(field)
    except ValueError as error:
        raise place.wrong("it", "whole numbers for id and size" if kind is int else "numbers", field) from error
