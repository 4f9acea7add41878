"""One view, drawn in strips of rows: whoever draws can show, wait or stop between them."""

from collections.abc import Generator
from dataclasses import replace

import torch

from aaplug.core.cameras import Camera
from aaplug.core.ellipses import cull
from aaplug.core.imaging import average_samples
from aaplug.core.splats import Render
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
    splats = renderer.splats(fine, samples)
    rules, weight = renderer.training.convention.rules, renderer.sampling(camera, samples)[1]
    pixel = renderer.recipe_through(camera).pixel
    rows, parts = max(1, SAMPLES_PER_STRIP // ((end - start) * samples**2)), []
    for top in range(0, camera.height, rows):
        yield
        above, below = max(0, top - HALO), min(camera.height, top + rows + HALO)
        hw = (below - above) * samples, (end - start) * samples
        x, y = start * samples, above * samples  # the strip's corner, from which its splats are seen
        seen = splats.camera
        if seen is not None:
            seen = replace(seen, cx=seen.cx - x, cy=seen.cy - y, height=hw[0], width=hw[1])
        moved = replace(splats, means=splats.means - splats.means.new_tensor([x, y]), camera=seen)
        ellipses = pixel.bounding_ellipses(moved, rules)
        visible = cull(moved, hw, kernels=renderer.kernels, ellipses=ellipses, rules=rules)
        strip = average_samples(renderer.paint(visible, hw), samples, weight)
        inner = slice(top - above, top - above + rows), slice(left - start, right - start)
        parts.append((strip.rgb[inner], strip.alpha[inner]))
    return Render(*(torch.cat(images) for images in zip(*parts, strict=True)))
