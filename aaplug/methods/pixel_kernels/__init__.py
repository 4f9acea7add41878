"""Pixel kernels: what a splat's alpha is at a pixel; one a file."""

from aaplug.methods.pixel_kernels import raster_rows
