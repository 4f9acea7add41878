"""What a page may ask for: every message is bounded, checked and refused in clear words.

A message is one JSON object.  {"see": ...} asks for a picture, {"shown": id} says that one has arrived, {"still": ...}
asks for a picture as a file.  No message names a file.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from aaplug.core.choices import QUALITIES
from aaplug.core.errors import SHOWN, UsageError, not_one_of
from aaplug.live.paints import PAINTS

MOST_BYTES = 16_384  # of a message
MOST_SIDE = 8192  # px of a picture
MOST_PIXELS = 1 << 25  # of a picture
FARTHEST = 1e9  # world units, and px of a focal length
ROUNDED = 1e-3  # by how much a pose's rotation may miss orthonormality: a page's own arithmetic misses 1e-12
POSE = 16  # numbers, row by row


@dataclass(frozen=True)
class Side:
    """How one side of the picture is drawn."""

    recipe: str
    quality: str


@dataclass(frozen=True)
class See:
    """A picture that a page wants to see.

    pose: `cam_from_world`, row by row.  focal, width, height: in px.
    split: share of the width that the left side fills.
    at: index of the training camera whose pose it is; else None.
    moving: whether the next one follows at once.  paint: what is painted over; photo: whether the photograph is.
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
    paint: str | None = None
    photo: bool = False


@dataclass(frozen=True)
class Still:
    """A picture wanted as a file, of the pose that is seen.  side: 0 or 1.  width, height: in px."""

    width: int
    height: int
    side: int


@dataclass(frozen=True)
class Shown:
    """The page has the picture of this number."""

    id: int


def parsed(text: str | bytes, recipes: Sequence[str], cameras: int) -> See | Still | Shown:
    """A message.

    recipes: names that may be asked for.  cameras: how many there are to stand in.

    Raises:
        UsageError: it is none of ours.
    """
    if not isinstance(text, str):
        raise UsageError("message", "takes text, got bytes")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UsageError("message", "is not JSON") from error
    if not isinstance(found, dict) or len(found) != 1 or next(iter(found)) not in ("see", "still", "shown"):
        raise UsageError("message", "takes one of see, still and shown")
    [(kind, body)] = found.items()
    if kind == "shown":
        return Shown(_whole({"shown": body}, "shown", 0, 2**53))
    if not isinstance(body, dict):
        raise UsageError(kind, f"takes an object, got {_short(body)}")
    if kind == "still":
        return Still(*_size(body), _whole(body, "side", 0, 1))
    return _see(body, recipes, cameras)


def _see(body: Mapping[str, Any], recipes: Sequence[str], cameras: int) -> See:
    sides = body.get("sides")
    if not isinstance(sides, list) or len(sides) != 2 or not all(isinstance(side, dict) for side in sides):
        raise UsageError("sides", f"takes two objects, got {_short(sides)}")
    left, right = (Side(_name(s, "recipe", recipes), _name(s, "quality", QUALITIES)) for s in sides)
    width, height = _size(body)
    return See(
        id=_whole(body, "id", 0, 2**53),
        pose=_pose(body),
        focal=_number(body, "focal", 1e-3, FARTHEST),
        width=width,
        height=height,
        split=_number(body, "split", 0.0, 1.0),
        sides=(left, right),
        at=None if body.get("at") is None else _whole(body, "at", 0, cameras - 1),
        moving=body.get("moving") is True,
        paint=None if body.get("paint") is None else _name(body, "paint", PAINTS),
        photo=body.get("photo") is True,
    )


def _pose(body: Mapping[str, Any]) -> tuple[float, ...]:
    found = body.get("pose")
    if not isinstance(found, list) or len(found) != POSE:
        raise UsageError("pose", f"takes {POSE} numbers, got {_short(found)}")
    numbers = tuple(_number({"pose": x}, "pose", -FARTHEST, FARTHEST) for x in found)
    matrix = torch.tensor(numbers, dtype=torch.float64).view(4, 4)
    rotation = matrix[:3, :3]
    apart = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
    if float(apart) > ROUNDED or float(torch.linalg.det(rotation)) < 0 or numbers[12:] != (0, 0, 0, 1):
        raise UsageError("pose", "takes a rotation and a translation, row by row")
    return numbers


def _size(body: Mapping[str, Any]) -> tuple[int, int]:
    width, height = (_whole(body, side, 1, 10**9) for side in ("width", "height"))
    if max(width, height) > MOST_SIDE or width * height > MOST_PIXELS:
        raise UsageError("size", f"is {width}x{height} px; the limit is {MOST_SIDE} a side and {MOST_PIXELS:,} in all")
    return width, height


def _number(body: Mapping[str, Any], name: str, least: float, most: float) -> float:
    value = body.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not least <= value <= most:
        raise UsageError(name, f"takes a number from {least:g} to {most:g}, got {_short(value)}")
    return float(value)


def _whole(body: Mapping[str, Any], name: str, least: int, most: int) -> int:
    value = _number(body, name, float(least), float(most))
    if value != math.floor(value):
        raise UsageError(name, f"takes a whole number, got {_short(body[name])}")
    return int(value)


def _name(body: Mapping[str, Any], name: str, known: Sequence[str] | Mapping[str, Any]) -> str:
    value = body.get(name)
    if not isinstance(value, str) or value not in known:
        raise UsageError(name, not_one_of(_short(value), known))
    return value


def _short(value: object) -> str:
    return str(value)[:SHOWN]
