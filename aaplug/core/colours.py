"""Colours behind a scene: red, green, blue in [0, 1]."""

from typing import Annotated

from aaplug.system.contracts import Range

Share = Annotated[float, Range(0, 1)]
Colour = tuple[Share, Share, Share]
Background = str | Colour  # as CSS writes it; auto is what training had

WHITE: Colour = (1.0, 1.0, 1.0)
BLACK: Colour = (0.0, 0.0, 0.0)
