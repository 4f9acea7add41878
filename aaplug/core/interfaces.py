"""Every seam on one page: what a plug-in receives, what it returns, and what it must hold to.

A selection chooses the Gaussians that a view draws.  A world filter acts once per scene, a screen filter once per
view on the projected splats.  A pixel kernel turns a splat into alpha at a pixel, a compositor turns alphas into light,
and a rasterizer does both for a whole image.  A metric compares two images.

Plug-ins are frozen dataclasses or functions.  They are deterministic, have no side effects and never change their
input.  `core.registry` lists them; the laws in `tests/laws` run over every one that is registered.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import Kernels
from aaplug.core.rules import RULES_3DGS, Rules
from aaplug.core.splats import Render, Splats2D
from aaplug.core.training import TrainingViews

Colour = tuple[float, float, float]


@runtime_checkable
class WorldFilter(Protocol):
    """Changes scales and opacities in the world, before a view is chosen, and records itself in `Gaussians.fused`."""

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Filter the scene.  Gaussians keep their number and order."""
        ...


@runtime_checkable
class Selection(Protocol):
    """Chooses which splats of one view are drawn, before any screen filter."""

    def __call__(self, splats: Splats2D, scene: Gaussians) -> Splats2D:
        """Return the chosen splats of `scene`, unchanged and in order.

        Raises:
            UsageError: the scene lacks what it chooses by.
        """
        ...

    def lacks(self, scene: Gaussians) -> str | None:
        """What the scene lacks to be chosen from, in words; None if nothing."""
        ...


@runtime_checkable
class ScreenFilter(Protocol):
    """Changes the covariances and opacities of one view's splats."""

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the splats of `camera`, whose sampling rate against training is `training.relative_rate(camera)`.

        With several samples per pixel, `camera` is the larger image that has the samples as its pixels.
        """
        ...


@runtime_checkable
class MatchesRates(Protocol):
    """A screen filter that compares each Gaussian's sampling rate with a chosen reference (`--rate-reference`)."""

    def with_reference(self, reference: str) -> ScreenFilter:
        """The same filter with another reference.

        Raises:
            UsageError: it knows no reference of that name.
        """
        ...


class Pixels(NamedTuple):
    """Pixels of square tiles: the tiles' top left corners, and one tile's pixel centres from its corner, in px."""

    corners: Float[Tensor, "t 2"]
    x: Float[Tensor, " P"]
    y: Float[Tensor, " P"]


@runtime_checkable
class PixelKernel(Protocol):
    """What a splat's alpha is at a pixel.

    m: splats; t: tiles; P: pixels per tile; c: columns of a raster row, laid out as in `pixel_kernels.raster_rows`.

    name: unique.
    columns: of a raster row.
    needs_depth_slopes: whether it draws discs, which need `Splats2D.depth_slopes`.
    splats_per_pass: how many splats of a tile one compiled pass composites; 8 suits all but the cheapest kernels.
    """

    @property
    def name(self) -> str: ...  # noqa: D102

    @property
    def columns(self) -> int: ...  # noqa: D102

    @property
    def needs_depth_slopes(self) -> bool: ...  # noqa: D102

    @property
    def splats_per_pass(self) -> int: ...  # noqa: D102

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D | None:
        """Splats whose cut-off ellipses contain every pixel centre with alpha above 0; None for the given splats."""
        ...

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m c"]:
        """One row per splat: everything that `alpha` needs, and the colour.  A row of zeros draws nothing."""
        ...

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, rules: Rules) -> Float[Tensor, "*n t P"]:
        """Alpha at each tile's pixels before the cap; 0 below the cut-off."""
        ...

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p c 2"]) -> Float[Tensor, "p c"]:
        """The slow float64 twin: alpha over opacity at `offsets` (px) from the splats, before cap and cut-off."""
        ...


@runtime_checkable
class Compositor(Protocol):
    """Another way to turn alphas into light than 3DGS's front-to-back product of transmittances."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def rows(self, splats: Splats2D) -> Float[Tensor, "m c"]:
        """One row per splat for `tiles`."""
        ...

    def tiles(
        self,
        rows: Float[Tensor, "m c"],
        window: float,
        order: Int[Tensor, " p"],
        first: Int[Tensor, " t"],
        counts: Int[Tensor, " t"],
        centres: tuple[Float[Tensor, "t P"], Float[Tensor, "t P"]],
        kernels: Kernels,
        rules: Rules,
    ) -> Float[Tensor, "4 t P"]:
        """Premultiplied colour, and alpha, of tiles; tile t draws the splats `order[first[t] : first[t] + counts[t]]`.

        centres: x and y of the pixels' centres, in px.  window: side of a pixel, in px.
        """
        ...

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """The slow float64 twin: premultiplied colour and transmittance of pixels, for splats sorted by depth."""
        ...


@runtime_checkable
class Rasterizer(Protocol):
    """Composites splats front to back over a background; splats of equal depth are drawn in scene order."""

    @property
    def name(self) -> str:
        """As shown to the user."""
        ...

    def __call__(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: Colour,
        pixel: PixelKernel,
        compositor: Compositor | None = None,
        rules: Rules = RULES_3DGS,
    ) -> Render:
        """Draw coloured splats into an image of height and width `hw`."""
        ...


@runtime_checkable
class RunsKernels(Protocol):
    """A rasterizer that says how the elementwise stages before it should run (default: eagerly)."""

    @property
    def kernels(self) -> Kernels: ...  # noqa: D102


@runtime_checkable
class CountsEvaluations(Protocol):
    """A rasterizer that can count the splat-pixel evaluations of compositing: the work of a frame on any machine."""

    def counting(self, add: Callable[[int], None]) -> Rasterizer:
        """The same rasterizer; it calls `add` with the number of evaluations of every pass."""
        ...


@runtime_checkable
class TakesMemory(Protocol):
    """A rasterizer that works in bands, within a memory budget."""

    def within(self, memory: float) -> Rasterizer:
        """The same rasterizer with a budget in bytes, beside the scene and the image."""
        ...
