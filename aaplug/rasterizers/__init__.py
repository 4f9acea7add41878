"""Rasterizers by name: `tiled`, eager or compiled, and the slow float64 `reference` that checks it."""

from typing import TYPE_CHECKING

from aaplug.system.registry import Registry

if TYPE_CHECKING:
    from aaplug.core.interfaces import Rasterizer

RASTERIZERS: Registry["Rasterizer"] = Registry(
    "rasterizer",
    "aaplug.core.interfaces:Rasterizer",
    {"eager": "aaplug.rasterizers.tiled.rasterizer:EAGER_TILED", "reference": "aaplug.rasterizers.reference:REFERENCE"},
)
