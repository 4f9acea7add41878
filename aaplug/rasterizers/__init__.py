"""Rasterizers by name: `tiled`, eager or compiled, and the slow float64 `reference` that checks it."""

from aaplug.rasterizers.choice import RASTERIZERS, find_rasterizer
from aaplug.rasterizers.reference import Reference
from aaplug.rasterizers.tiled import Tiled
