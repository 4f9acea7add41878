"""The names of `gsplat.rendering` that aaplug draws."""

from aaplug.gsplat.drop_in import rasterization
from aaplug.gsplat.surfels import rasterization_2dgs

__all__ = ["rasterization", "rasterization_2dgs"]
