"""Pixel kernels: what a splat's alpha is at a pixel; one a file."""
