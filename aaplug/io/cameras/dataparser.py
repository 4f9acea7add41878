"""nerfstudio's `dataparser_transforms.json`: maps the frame of `transforms.json` to that of the trained scene.

{transform: 3×4, rotation and translation, row by row; scale}.  A point p becomes scale · (R p + t).

Functions raise FormatError for a file that breaks its format.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from aaplug.core.errors import FormatError
from aaplug.io.cameras.poses import pose
from aaplug.io.values import Entry, Place, read_json

DATAPARSER = "dataparser_transforms.json"


@dataclass(frozen=True)
class Dataparser:
    """A rigid motion, followed by a scale."""

    motion: Float[Tensor, "4 4"]
    scale: float

    def moved(self, world_from_cam: Float[Tensor, "4 4"]) -> Float[Tensor, "4 4"]:
        """A camera's pose in the trained frame."""
        moved = self.motion @ world_from_cam
        moved[:3, 3] *= self.scale
        return moved


def read_dataparser(path: Path) -> Dataparser | None:
    """Read the file; None if there is none."""
    if not os.path.isfile(path):
        return None
    document = read_json(path)
    place = Place(path, "it")
    if not isinstance(document, dict):
        raise FormatError(path, "should be an object with transform and scale")
    entry = Entry(place, document)
    matrix, scale = entry.matrix("transform", 3, 4), entry.number("scale")
    if not scale > 0:
        raise place.wrong("scale", "above 0", scale)
    return Dataparser(pose(matrix[:, :3], matrix[:, 3], place, "transform"), scale)
