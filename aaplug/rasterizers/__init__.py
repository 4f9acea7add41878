"""Rasterizers by name; a new one is a file here and a line below."""

from aaplug.interfaces import Rasterizer
from aaplug.rasterizers import reference, tiled
from aaplug.rasterizers.supersampled import averaged

RASTERIZERS: dict[str, Rasterizer] = {
    "tiled": tiled.rasterize,
    "reference": reference.rasterize,
}

__all__ = ["RASTERIZERS", "averaged"]
