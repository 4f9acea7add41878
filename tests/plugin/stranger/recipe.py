"""A recipe: our screen filter with our pixel kernel."""

from aaplug import Recipe

from .pixel_kernel import FOUR_POINTS
from .screen_filter import SOFT

SOFT_POINTS = Recipe(
    "soft-points",
    screen=SOFT,
    pixel=FOUR_POINTS,
    source="nobody's: the example of examples/guides/contributing.md",
    when="trying out plug-ins",
)
