"""Messages of a page: each is bounded, and checked or refused in clear words.

A message is one JSON object.  {"see": ...} asks for a picture, {"shown": id} says that one has arrived, {"still": ...}
asks for a picture as a file, {"pick": ...} for the depth of what a place of the picture shows, and {"open": ...}
announces a scene file, whose bytes follow in binary messages.  None names a file of this machine.
"""

import re
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from aaplug.core.cameras import check_rigid
from aaplug.core.colours import Colour
from aaplug.io.images import colour_of
from aaplug.io.values import Entry, Place, entries, focal, natural, number, numbers, parse_json
from aaplug.io.values import text as printable_text
from aaplug.live.overlays import OVERLAYS
from aaplug.methods import QUALITIES
from aaplug.system.errors import UsageError

KINDS = ("see", "still", "pick", "open", "shown")
MAX_MESSAGE_BYTES = 65_536
MAX_SIDE = 8192  # px of a picture
MAX_PIXELS = 1 << 25  # of a picture
MESSAGE = Path("message")  # that errors name
NUMBERED = partial(natural, most=2**53)  # a page counts in float64
SIDE = partial(natural, most=MAX_SIDE, least=1, unit=" of px")
COLOUR = re.compile("#[0-9a-f]{6}")
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


Order = StillRequest | PickRequest  # beside the picture that is wanted last, all are served


def parse(text: str | bytes, recipes: Sequence[str], cameras: int) -> PictureRequest | Order | OpenRequest | None:
    """Read a message; None says that a picture has arrived.

    recipes: names that may be asked for.  cameras: how many there are to stand in.

    Raises FormatError if it is none of ours, and UsageError for an empty file or a pose that is no rigid motion.
    """
    message = parse_json(text if isinstance(text, bytes) else text.encode(), MESSAGE)
    place = Place(MESSAGE, "it")
    right = isinstance(message, dict) and len(message) == 1 and message.keys() <= {*KINDS}
    place.expect(right, "it", f"one of {', '.join(KINDS)}", message)
    [kind] = message
    whole = Entry(place, message)
    if kind == "shown":
        whole.get("shown", NUMBERED)
        return None
    body = whole.entry(kind)
    if kind == "open":
        name = body.get("name", printable_text)
        right = bool(re.fullmatch(FILE_NAME, name)) and len(name.encode()) <= MAX_NAME_BYTES
        body.place.expect(right, "name", "the name of a scene file", name)
        size = body.get("size", NUMBERED)
        if not size:
            raise UsageError(name, "is empty")
        return OpenRequest(name, size)
    if kind == "pick":
        return PickRequest(body.get("x", _share), body.get("y", _share))
    width, height = (body.get(side, SIDE) for side in ("width", "height"))
    body.place.expect(width * height <= MAX_PIXELS, "size", f"at most {MAX_PIXELS:,} px", f"{width}x{height}")
    if kind == "still":
        return StillRequest(width, height, body.get("side", partial(natural, most=1)))
    sides = entries(MESSAGE, "side", body.value("sides"))
    body.place.expect(len(sides) == 2, "sides", "two", len(sides))
    left, right = (
        Side(side.get("recipe", _one_of(recipes)), side.get("quality", _one_of(QUALITIES))) for side in sides
    )
    given = {key for key, value in body.fields.items() if value is not None}
    colour = body.get("background", printable_text) if "background" in given else None
    body.place.expect(colour is None or bool(COLOUR.fullmatch(colour)), "background", "#rrggbb", colour)
    pose = tuple(numbers(body.value("pose"), POSE_NUMBERS, body.place, "pose"))
    check_rigid([pose[row : row + 4] for row in range(0, POSE_NUMBERS, 4)])
    return PictureRequest(
        id=body.get("id", NUMBERED),
        pose=pose,
        focal=body.get("focal", focal),
        width=width,
        height=height,
        split=body.get("split", _share),
        sides=(left, right),
        at=body.get("at", partial(natural, most=cameras - 1)) if "at" in given else None,
        moving=body.fields.get("moving") is True,
        overlay=body.get("paint", _one_of(OVERLAYS)) if "paint" in given else None,
        photo=body.fields.get("photo") is True,
        background=None if colour is None else colour_of(colour),
    )


def _share(value: object, place: Place, field: str) -> float:
    real = number(value, place, field)
    place.expect(0 <= real <= 1, field, "from 0 to 1", value)
    return real


def _one_of(names: Collection[str]) -> Callable[[object, Place, str], str]:
    def check(value: object, place: Place, field: str) -> str:
        place.expect(value in list(names), field, f"one of {', '.join(names)}", value)
        return str(value)

    return check
