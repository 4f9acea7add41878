"""Options of `render`."""

from dataclasses import dataclass
from typing import Literal

from aaplug.options.shared import ImageOptions, RecipeOptions


@dataclass(frozen=True, kw_only=True)
class RenderOptions(RecipeOptions, ImageOptions):
    """Rendering."""

    bit_depth: Literal[8, 16] = 8
    """Bits per colour channel."""
