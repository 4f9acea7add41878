"""Passes: what a rendered view can hold beside its colours, by name.

They are plain data and import no torch, so that the command line knows their names at once.
"""

from dataclasses import dataclass
from typing import Literal

NormalAxes = Literal["camera", "world"]


@dataclass(frozen=True)
class Pass:
    """A pass.  channels: a letter for each.  layer: its name in a file of layers; "" for the picture itself.

    exact: the values need float32; else half precision does.
    """

    channels: str
    layer: str
    exact: bool = True


# `rendering.passes` states the rule of each
PASSES = {
    "rgb": Pass("RGB", "", exact=False),
    "alpha": Pass("A", "", exact=False),
    "depth": Pass("Z", "depth"),
    "depth-median": Pass("Z", "depth_median"),
    "depth-nearest": Pass("Z", "depth_nearest"),
    "normal": Pass("XYZ", "normal", exact=False),
    "position": Pass("XYZ", "position"),
    "id": Pass("V", "id"),
    "samples": Pass("V", "samples"),
    "bound": Pass("V", "bound"),
}
