"""Messages of a page: each is bounded, and checked or refused in clear words.

A message is one JSON object.  {"see": ...} asks for a picture, {"shown": id} says that one has arrived, {"still": ...}
asks for a picture as a file, {"pick": ...} for the depth of what a place of the picture shows, and {"open": ...}
announces a scene file, whose bytes follow in binary messages.  None names a file of this machine.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from aaplug.core.cameras import check_rigid
from aaplug.core.colours import Colour
from aaplug.io.images import colour_of
from aaplug.live.overlays import OVERLAYS
from aaplug.methods import QUALITIES
from aaplug.system.errors import MAX_VALUE_CHARACTERS, UsageError, not_one_of

KINDS = ("see", "still", "pick", "open", "shown")
MAX_MESSAGE_BYTES = 65_536
MAX_SIDE = 8192  # px of a picture
MAX_PIXELS = 1 << 25  # of a picture
MAX_DISTANCE = 1e9  # world units, and px of a focal length
MAX_ID = 2**53  # a page counts in float64
FILE_NAME = r"[^./\\:][^/\\:]*"  # on any system
MAX_NAME_BYTES = 255
POSE_NUMBERS = 16  # row by row


@dataclass(frozen=True)
class Side:
    """Recipe and quality of one side of the picture."""

    recipe: str
    quality: str


@dataclass(frozen=True)
class PictureRequest:
    """A picture that a page wants to see.

    pose: `cam_from_world`, row by row.  focal, width, height: in px.
    split: share of the width that the left side fills.
    at: index of the training camera whose pose it is; else None.  background: None for that of the scene.
    moving: True if the next request follows at once.
    overlay: name of the overlay to send along.  photo: True to send the photograph along.
    """

    id: int
    pose: tuple[float, ...]
    focal: float
    width: int
    height: int
    split: float
    sides: tuple[Side, Side]
    at: int | None = None
    moving: bool = False
    overlay: str | None = None
    photo: bool = False
    background: Colour | None = None


@dataclass(frozen=True)
class StillRequest:
    """A picture wanted as a file, of the pose that is seen.  side: 0 or 1.  width, height: in px."""

    width: int
    height: int
    side: int


@dataclass(frozen=True)
class PickRequest:
    """A place of the picture whose depth is wanted, in shares of width and height."""

    x: float
    y: float


@dataclass(frozen=True)
class OpenRequest:
    """A scene file that follows.  name: the file's own, without a folder.  size: in bytes."""

    name: str
    size: int


@dataclass(frozen=True)
class Receipt:
    """The page has the picture of this number."""

    id: int


Order = StillRequest | PickRequest  # beside the picture that is wanted last, all are served


def parse(text: str | bytes, recipes: Sequence[str], cameras: int) -> PictureRequest | Order | OpenRequest | Receipt:
    """Read a message.

    recipes: names that may be asked for.  cameras: how many there are to stand in.

    Raises UsageError if it is none of ours.
    """
    if not isinstance(text, str):
        raise UsageError("message", "takes text, got bytes")
    try:
        message = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError("message", "is not JSON") from error
    if not isinstance(message, dict) or len(message) != 1 or next(iter(message)) not in KINDS:
        raise UsageError("message", f"takes one of {', '.join(KINDS)}")
    [(kind, body)] = message.items()
    if kind == "shown":
        return Receipt(_whole(message, "shown", 0, MAX_ID))
    if not isinstance(body, dict):
        raise UsageError(kind, f"takes an object, got {_short(body)}")
    if kind == "open":
        name = body.get("name")
        if not isinstance(name, str) or not _is_file_name(name):
            raise UsageError("name", f"takes the name of a scene file, got {_short(name)}")
        size = _whole(body, "size", 0, MAX_ID)
        if not size:
            raise UsageError(name, "is empty")
        return OpenRequest(name, size)
    if kind == "pick":
        return PickRequest(_number(body, "x", 0.0, 1.0), _number(body, "y", 0.0, 1.0))
    width, height = (_whole(body, side, 1, 10**9) for side in ("width", "height"))
    if max(width, height) > MAX_SIDE or width * height > MAX_PIXELS:
        raise UsageError("size", f"is {width}x{height} px; the limit is {MAX_SIDE} a side and {MAX_PIXELS:,} in all")
    if kind == "still":
        return StillRequest(width, height, _whole(body, "side", 0, 1))
    sides = body.get("sides")
    if not isinstance(sides, list) or len(sides) != 2 or not all(isinstance(side, dict) for side in sides):
        raise UsageError("sides", f"takes two objects, got {_short(sides)}")
    colour = body.get("background")
    if colour is not None and not (isinstance(colour, str) and re.fullmatch("#[0-9a-f]{6}", colour)):
        raise UsageError("background", f"takes #rrggbb, got {_short(colour)}")
    left, right = (Side(_name(side, "recipe", recipes), _name(side, "quality", QUALITIES)) for side in sides)
    return PictureRequest(
        id=_whole(body, "id", 0, MAX_ID),
        pose=_pose(body),
        focal=_number(body, "focal", 1e-3, MAX_DISTANCE),
        width=width,
        height=height,
        split=_number(body, "split", 0.0, 1.0),
        sides=(left, right),
        at=None if body.get("at") is None else _whole(body, "at", 0, cameras - 1),
        moving=body.get("moving") is True,
        overlay=None if body.get("paint") is None else _name(body, "paint", OVERLAYS),
        photo=body.get("photo") is True,
        background=None if colour is None else colour_of(colour),
    )


def _pose(body: Mapping[str, Any]) -> tuple[float, ...]:
    """The numbers of a rigid motion, row by row."""
    pose = body.get("pose")
    if not isinstance(pose, list) or len(pose) != POSE_NUMBERS:
        raise UsageError("pose", f"takes {POSE_NUMBERS} numbers, got {_short(pose)}")
    numbers = tuple(_number({"pose": x}, "pose", -MAX_DISTANCE, MAX_DISTANCE) for x in pose)
    try:
        check_rigid([numbers[row : row + 4] for row in range(0, POSE_NUMBERS, 4)])
    except UsageError as error:
        raise UsageError("pose", "takes a rotation and a translation, row by row") from error
    return numbers


def _number(body: Mapping[str, Any], name: str, least: float, most: float) -> float:
    value = body.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise UsageError(name, f"takes a number from {least:g} to {most:g}, got {_short(value)}")
    return float(value)


def _is_file_name(name: str) -> bool:
    return bool(re.fullmatch(FILE_NAME, name)) and name.isprintable() and len(name.encode()) <= MAX_NAME_BYTES


def _whole(body: Mapping[str, Any], name: str, least: int, most: int) -> int:
    value = _number(body, name, float(least), float(most))
    if value != math.floor(value):
        raise UsageError(name, f"takes a whole number, got {_short(body[name])}")
    return int(value)


def _name(body: Mapping[str, Any], name: str, choices: Sequence[str] | Mapping[str, Any]) -> str:
    value = body.get(name)
    if not isinstance(value, str) or value not in choices:
        raise UsageError(name, not_one_of(str(value)[:MAX_VALUE_CHARACTERS], choices))
    return value


def _short(value: object) -> str:
    return str(value)[:MAX_VALUE_CHARACTERS] or "nothing"
