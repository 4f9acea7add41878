"""The fast rasterizer, in tiles: binning, compositing forward and backward, and its kernels compiled ahead of time."""

from aaplug.rasterizers.tiled.rasterizer import Tiled
