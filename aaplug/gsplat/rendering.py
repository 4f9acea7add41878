"""The names of `gsplat.rendering` that aaplug draws: its `rasterization`."""

from aaplug.gsplat.drop_in import rasterization

__all__ = ["rasterization"]
