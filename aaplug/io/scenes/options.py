"""Options for reading and writing scene files; each format uses those that concern it."""

from dataclasses import dataclass
from typing import get_args

from aaplug.io import SpzAxes
from aaplug.system.contracts import check_fields
from aaplug.system.errors import UsageError


@dataclass(frozen=True)
class SceneFileOptions:
    """The user's choices; raises UsageError for unknown axes.

    allow_checkpoint: open a .pt, a pickle, of which only tensors are read.
    spz_axes: axes of the numbers in a .spz: "opengl" by its specification, "opencv" as splat-transform and gsply write,
        or "auto": written by the specification, and read as fits the cameras.
    """

    allow_checkpoint: bool = False
    spz_axes: SpzAxes = "auto"

    def __post_init__(self) -> None:
        check_fields(self)
        choices = get_args(SpzAxes)
        if self.spz_axes not in choices:
            raise UsageError("spz_axes", f"should be {' or '.join(choices)}, not {self.spz_axes!r}")
