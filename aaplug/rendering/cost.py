"""The cost of rendering, estimated before it starts.

Times are those of examples/guides/speed.md, on two cores; other machines differ by a factor of two or so.
"""

from collections.abc import Iterable
from operator import mul
from typing import NamedTuple

from aaplug.core.cameras import Camera
from aaplug.core.exposures import frame_count
from aaplug.io.limits import SAMPLE_BYTES
from aaplug.rendering.renderer import Renderer

COMPILED = 0.19e-6, 0.047e-6  # seconds per Gaussian of the scene, and per sample of the image
EAGER = 0.64e-6, 0.29e-6
GRADIENTS = 4.0  # a frame with gradients, its loss and the optimizer's step against one without, on the chair
COMPARED = 0.3e-6  # seconds per pixel: an image compared with its truth by PSNR and SSIM, on the chair


class Cost(NamedTuple):
    """Seconds of work; bytes of the scene, and of the largest image."""

    seconds: float
    scene: float
    image: float


def cost_of(renderers: Iterable[Renderer], views: Iterable[Camera]) -> Cost:
    """The cost of rendering every view with every renderer, one after another."""
    views, found = list(views), Cost(0.0, 0.0, 0.0)
    counts = [*map(frame_count, views)]
    for renderer in renderers:
        per_gaussian, per_sample = COMPILED if renderer.rasterizer.name == "compiled" else EAGER
        samples = [view.width * view.height * renderer.samples(view) ** 2 for view in views]
        drawn = sum(map(mul, counts, samples))
        found = Cost(
            found.seconds + per_gaussian * len(renderer.scene) * sum(counts) + per_sample * drawn,
            max(found.scene, renderer.scene.sh.untyped_storage().nbytes()),
            max(found.image, SAMPLE_BYTES * max(samples, default=0)),
        )
    return found
