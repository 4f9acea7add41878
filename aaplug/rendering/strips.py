"""One view, drawn in strips of rows: whoever draws can show, wait or stop between them."""

from collections.abc import Generator
from dataclasses import replace

import torch

from aaplug.core.cameras import Camera
from aaplug.core.culling import cull
from aaplug.core.imaging import average_samples
from aaplug.core.splats import Render, Splats2D
from aaplug.rendering.renderer import Renderer

SAMPLES_PER_STRIP = 1 << 19  # some 30 ms on two cores
HALO = 1  # px beyond a strip's sides: neighbours of its samples lie there


@torch.no_grad()
def strips(
    renderer: Renderer, camera: Camera, samples: int, columns: tuple[int, int] | None = None
) -> Generator[None, None, Render]:
    """Draw some columns of a view as `Renderer.draw` draws all of them; yields before each strip, returns the render.

    All of the view is projected, because an image's size decides how splats beside it are projected.

    samples: along a pixel's side.  columns: the first, and one past the last; None for all.
    """
    left, right = columns or (0, camera.width)
    start, end = max(0, left - HALO), min(camera.width, right + HALO)
    fine = camera.resized(camera.width * samples, camera.height * samples)
    splats, soft = _moved(renderer.splats(fine, samples), -start * samples, 0), renderer.neighbours(camera, samples)
    fine = replace(fine, width=(end - start) * samples)
    rows, drawn = max(1, SAMPLES // (fine.width * samples)), []
    for top in range(0, camera.height, rows):
        yield
        bottom = min(top + rows, camera.height)
        drawn.append(_strip(renderer, splats, fine.hw, (top, bottom), samples, soft))
    whole = Render(*(torch.cat(parts) for parts in zip(*drawn, strict=True)))
    return Render(*(image[:, left - start : right - start] for image in whole))


def _strip(
    renderer: Renderer, splats: Splats2D, whole: tuple[int, int], rows: tuple[int, int], samples: int, soft: float
) -> Render:
    """Some rows of pixels; whole: height and width of all samples."""
    top, bottom = max(0, rows[0] - HALO), min(whole[0] // samples, rows[1] + HALO)
    pixel, rules = renderer.recipe.pixel, renderer.training.convention.rules
    moved, hw = _moved(splats, 0, -top * samples), ((bottom - top) * samples, whole[1])
    here = cull(moved, hw, kernels=renderer.kernels, ellipses=pixel.bounding_ellipses(moved, rules), rules=rules)
    image = renderer.paint(here, hw)
    pixels = average_samples(image, samples, soft)
    inner = slice(rows[0] - top, rows[1] - top)
    return Render(pixels.rgb[inner], pixels.alpha[inner])


def _moved(splats: Splats2D, right: int, down: int) -> Splats2D:
    return replace(splats, means=splats.means + splats.means.new_tensor([right, down]))
