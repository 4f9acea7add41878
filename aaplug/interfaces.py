"""Every seam on one page: what a plug-in gets, what it gives back, and what it must hold to.

A world filter acts once per scene; a selection says which Gaussians a view draws at all; a screen filter acts per view
on the projected splats; a rasterizer turns splats into an image.  Each is a frozen dataclass or a function,
deterministic, without side effects, and never changes its input.  A plug-in is one file and one line in its folder's
`__init__`; the laws in `tests/laws` then run over it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Literal, Protocol, runtime_checkable

from aaplug.cameras import Camera
from aaplug.gaussians import Convention, Gaussians
from aaplug.kernels import Kernels
from aaplug.sampling import SamplingBounds
from aaplug.splats import Render, Splats2D

# What alpha is at a pixel: the Gaussian's value at its centre; its mean over the pixel by the normal distribution, by
# Analytic-Splatting's logistic approximation of it, or over the pixel's own square (`rasterizers.pixels`); a disc's
# value where the ray meets it, as 2DGS and AA-2DGS have it (`rasterizers.surfels`); or its mean over the window that
# light still passes (`rasterizers.blending`).
PixelKernel = Literal["point", "integral", "logistic", "square", "surfel", "surfel-mip", "blending"]


@dataclass(frozen=True)
class Training:
    """What is known at test time about training: how it rendered, and how finely its cameras sampled the scene.

    guard: share of an image's longer side; training drew no Gaussian whose centre lay farther outside the image.
    3DGS and gsplat draw them all, but a scene trained with such a guard band is hazy without it.
    """

    convention: Convention
    cameras: Sequence[Camera]
    bounds: SamplingBounds
    guard: float = math.inf

    def rate(self, camera: Camera) -> float:
        """How finely a view samples the scene against training: 1 at the training size, 1/2 at half of it.

        A free camera is compared with the training cameras' median focal length.
        """
        trained = camera.trained_focal or median(c.focal for c in self.cameras)
        return camera.focal / trained


@runtime_checkable
class WorldFilter(Protocol):
    """Changes scales and opacities in the world, before a view is chosen, and records itself in `Gaussians.fused`."""

    def __call__(self, scene: Gaussians, training: Training) -> Gaussians:
        """Filter the scene; Gaussians keep their number and order."""
        ...


@runtime_checkable
class Selection(Protocol):
    """Chooses which splats of one view are drawn, before any screen filter."""

    def __call__(self, splats: Splats2D, scene: Gaussians) -> Splats2D:
        """The chosen ones of the splats of `scene`, unchanged and in order.

        Raises:
            UsageError: the scene does not hold what it chooses by.
        """
        ...


@runtime_checkable
class ScreenFilter(Protocol):
    """Changes the covariances and opacities of one view's splats."""

    def __call__(self, splats: Splats2D, camera: Camera, training: Training) -> Splats2D:
        """Filter the splats of `camera`; `training.rate(camera)` says how finely it samples against training.

        Where a pixel takes several samples, `camera` is the larger image that the samples are pixels of.
        """
        ...


@runtime_checkable
class Rasterizer(Protocol):
    """Composites splats front to back over a background.

    The rules are 3DGS's: alpha = min(0.99, opacity·Gaussian at the pixel), skipped below 1/255; a pixel stops before
    the splat that would bring its transmittance under 1e-4; splats of equal depth are drawn in scene order.
    """

    @property
    def kernels(self) -> Kernels:
        """How the elementwise stages run, those before the rasterizer as well."""
        ...

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: tuple[float, float, float],
        pixel: PixelKernel = "point",
    ) -> Render:
        """Draw coloured splats into an image of height and width `hw`."""
        ...
