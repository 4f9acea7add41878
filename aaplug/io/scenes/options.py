"""Options for reading and writing scene files; each format uses those that concern it."""

from dataclasses import dataclass

from aaplug.core.conventions import SpzAxes, SpzVersion
from aaplug.system.contracts import check_fields


@dataclass(frozen=True)
class SceneFileOptions:
    """The user's choices; raises UsageError for unknown axes and versions.

    allow_checkpoint: open a .pt, a pickle, of which only tensors are read.
    spz_axes: axes of the numbers in a .spz: "opengl" by its specification, "opencv" as splat-transform and gsply write,
        or "auto": written by the specification, and read as the file says, or else as fits the cameras.
    spz_version: of a .spz to write.
    """

    allow_checkpoint: bool = False
    spz_axes: SpzAxes = "auto"
    spz_version: SpzVersion = 4

    def __post_init__(self) -> None:
        check_fields(self)
