"""Rasterizers by name; a new one is a file here and a line below."""

from aaplug.interfaces import Rasterizer
from aaplug.rasterizers.extents import SURFELS, extents_of
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.supersampled import averaged
from aaplug.rasterizers.tiled import Tiled

RASTERIZERS: dict[str, Rasterizer] = {
    "eager": Tiled(),
    "reference": Reference(),
}

__all__ = ["RASTERIZERS", "SURFELS", "Reference", "Tiled", "averaged", "extents_of"]
