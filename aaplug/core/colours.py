"""Colours behind a scene: red, green, blue in [0, 1]."""

from typing import Literal

Colour = tuple[float, float, float]
Background = Literal["auto", "white", "black"] | Colour

WHITE: Colour = (1.0, 1.0, 1.0)
BLACK: Colour = (0.0, 0.0, 0.0)
