"""Options of `video`."""

from dataclasses import dataclass
from typing import Annotated

from aaplug.core.choices import MOST_FPS
from aaplug.options.base import UNSET, OneOf, choice, number
from aaplug.options.objects import AnyPath
from aaplug.options.shared import RECIPE_NAMES, SCALE, ImageOptions, RecipeOptions


@dataclass(frozen=True, kw_only=True)
class VideoOptions(RecipeOptions, ImageOptions):
    """Rendering, and the camera path."""

    scale: Annotated[float | None, SCALE, UNSET] = None
    """Size relative to the training size, or to that of a path file (default: 1)."""
    path: Annotated[AnyPath, choice(["zoom", "dolly", "orbit", "FILE.json"])] = "zoom"
    """zoom (focal length), dolly (distance) or orbit from the first of --views, or nerfstudio's camera_path.json."""
    beside: Annotated[str | None, choice(["none", *RECIPE_NAMES, "..."]), OneOf(("none",), "recipe")] = "classic"
    """Recipe to show on the left; none shows --recipe alone."""
    start: Annotated[float, SCALE] = 1.0
    """Sampling rate at the start of a zoom or dolly, relative to training."""
    end: Annotated[float, SCALE] = 0.125
    """Sampling rate where it turns back."""
    seconds: Annotated[float, number(0.01, 3600)] = 6.0
    """Length in seconds of a zoom, dolly or orbit."""
    fps: Annotated[float | None, number(0.1, MOST_FPS), UNSET] = None
    """Frames per second (default: the path file's, or 30)."""
