"""The settings of an INRIA training run: `cfg_args`, the text of a Python `Namespace(...)`.

The text comes with downloaded scenes, so it is parsed and never evaluated: one call of `Namespace` whose keywords are
literals.  `source_path` names a folder, maybe of another machine: it is told, and nothing in it is read.

Functions raise FormatError for a file that breaks its format.
"""

import ast
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

from aaplug.io.limits import whole_limit
from aaplug.io.values import Entry, Place, number, read_bounded, text
from aaplug.system.errors import FormatError

NAME = "cfg_args"
CAPPED = -1.0  # 3DGS's default resolution: the width capped at WIDTH_CAP
WIDTH_CAP = 1600  # px: 3DGS, utils/camera_utils.py
DIVISORS = (1, 2, 4, 8)  # resolutions that divide the size; others are a width in px


@dataclass(frozen=True)
class CfgArgs:
    """A run's settings that concern its images.

    resolution: a divisor in DIVISORS, CAPPED, or a width in px.
    images: the folder of the photos, in the data set `source`, which is empty if the file does not say.
    white_background: None if the file does not say.
    held_out: true if every 8th view was kept from training (eval).
    """

    resolution: float = CAPPED
    images: str = "images"
    source: str = ""
    white_background: bool | None = None
    held_out: bool = False

    @property
    def divisor(self) -> int:
        """The divisor in the name of the photos' folder: 4 for images_4."""
        match = re.search(r"_([1-9][0-9]?)$", self.images)
        return int(match[1]) if match else 1

    def size(self, width: int, height: int) -> tuple[int, int]:
        """The size at which 3DGS trains on an image of this size."""
        if self.resolution in DIVISORS:
            return max(1, round(width / self.resolution)), max(1, round(height / self.resolution))
        target = min(width, WIDTH_CAP) if self.resolution == CAPPED else int(self.resolution)
        return target, max(1, height * target // width)  # 3DGS truncates here, and rounds above


UNKNOWN = CfgArgs()  # of a run without the file


def read_cfg_args(path: Path) -> CfgArgs:
    """Read the settings that concern cameras; those that the file does not mention have their defaults."""
    source, settings = read_bounded(path, whole_limit("CFG_ARGS")), {}
    try:
        with warnings.catch_warnings(action="ignore"):  # Python's, about backslashes in Windows paths
            call = ast.parse(source.decode().strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise FormatError(path, f"should be a Python Namespace(...): {error}") from error
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name)):
        raise FormatError(path, "should be a Python Namespace(...)")
    if call.func.id != "Namespace" or call.args or not all(keyword.arg for keyword in call.keywords):
        raise FormatError(path, f"should be Namespace(name=value, ...), not {call.func.id}(...)")
    for keyword in call.keywords:
        try:
            settings[str(keyword.arg)] = ast.literal_eval(keyword.value)
        except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
            problem = f"{keyword.arg} should be a literal (number, text, True, list); code is never run"
            raise FormatError(path, problem) from error
    entry, most = Entry(Place(path, "Namespace"), settings), whole_limit("CAMERA_SIDE")
    resolution = entry.get("resolution", number, CAPPED)
    right = resolution == CAPPED or 1 <= resolution <= most
    entry.place.expect(right, "resolution", f"-1, 1, 2, 4, 8 or a width up to {most} px", resolution)
    white, held_out = (settings.get(field) for field in ("white_background", "eval"))
    for field, value in (("white_background", white), ("eval", held_out)):
        entry.place.expect(value is None or isinstance(value, bool), field, "True or False", value)
    images, source = entry.get("images", text, CfgArgs.images), settings.get("source_path")
    return CfgArgs(resolution, images, source if isinstance(source, str) else "", white, bool(held_out))
