"""The rendering interfaces of plug-ins: arguments, results and guarantees.

A world filter acts once per scene.  Per view, a selection picks the splats to draw and a screen filter changes their
covariances and opacities.  A pixel kernel gives a splat's alpha at a pixel, a compositor turns alphas into colour, and
a rasterizer does both for a whole image.  Recipes, metrics and file formats have their interfaces in `methods.recipe`,
`evaluation.metric`, `io.scenes` and `io.cameras`.

Plug-ins are frozen dataclasses or functions.  They are deterministic, have no side effects and never change their
input.  Each kind has a `system.registry.Registry`; `tests/laws` checks every registered filter, pixel kernel,
compositor, rasterizer and recipe.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.colours import Colour
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import Kernel, Kernels
from aaplug.core.rules import RULES_3DGS, Rules, float32, just_below
from aaplug.core.splats import Render, Splats2D
from aaplug.core.training import TrainingViews


@runtime_checkable
class WorldFilter(Protocol):
    """Changes scales and opacities in the world, before a view is chosen, and records itself in `Gaussians.fused`."""

    def __call__(self, scene: Gaussians, training: TrainingViews) -> Gaussians:
        """Filter the scene.  Gaussians keep their number and order."""
        ...


@runtime_checkable
class Selection(Protocol):
    """Picks the splats of one view to draw, after projection and before the screen filter."""

    def __call__(self, splats: Splats2D, scene: Gaussians) -> Splats2D:
        """Return a subset of `splats`, unchanged and in their order; `splats.sources` index `scene`.

        Raises:
            UsageError: the scene lacks what it chooses by.
        """
        ...

    def lacks(self, scene: Gaussians) -> str | None:
        """The facts that this selection needs and the scene lacks, in words; None if it lacks nothing."""
        ...


@runtime_checkable
class ScreenFilter(Protocol):
    """Changes the covariances and opacities of one view's splats."""

    def __call__(self, splats: Splats2D, camera: Camera, training: TrainingViews) -> Splats2D:
        """Filter the view's splats; `training.relative_rate(camera)` is the view's rate relative to training.

        With several samples per pixel, `camera` is that of the supersampled image.
        """
        ...


@runtime_checkable
class ReadsColumns(Protocol):
    """A screen filter that reads further columns of the scene, `Gaussians.extras`, by name."""

    @property
    def columns(self) -> tuple[str, ...]: ...  # noqa: D102

    def reading(self, values: Mapping[str, Float[Tensor, " m"]]) -> ScreenFilter:
        """The same filter for splats with these values of the columns."""
        ...


class Pixels(NamedTuple):
    """Pixel centres of square tiles, in px: each tile's top left corner, and x and y of its P centres from there.

    For a pixel kernel that `ReadsRays`, x, y and z of each pixel's ray instead.

    at_corners: u and v of one splat per tile at the tile's corner, where a compiled pass has them.
    """

    corners: Float[Tensor, "t 2"]
    x: Float[Tensor, "*t P"]
    y: Float[Tensor, "*t P"]
    z: Float[Tensor, "t P"] | None = None
    at_corners: tuple[Float[Tensor, " t"], Float[Tensor, " t"]] | None = None


class Limits(NamedTuple):
    """The rules as a kernel computes with them.

    Eager code takes numbers.  A compiled kernel takes tensors without dimensions, so that it serves all rules.

    below_min_alpha, below_min_transmittance: the float32 below each.
    """

    max_alpha: float | Tensor
    below_min_alpha: float | Tensor
    log2_min_alpha: float | Tensor
    below_min_transmittance: float | Tensor

    @classmethod
    def by(cls, rules: Rules) -> "Limits":
        """The limits of some rules, as numbers."""
        cutoff, least = rules.min_alpha, rules.min_transmittance
        return cls(rules.max_alpha, just_below(cutoff), float32(math.log2(float32(cutoff))), just_below(least))

    @classmethod
    def of(cls, values: Float[Tensor, " 4"]) -> "Limits":
        """The limits that a kernel is given in one tensor."""
        return cls(*(values.unbind() if torch.compiler.is_compiling() else values.tolist()))

    def cut(self, alpha: Float[Tensor, "*any"]) -> Float[Tensor, "*any"]:
        """Return `alpha` where it is at least the cut-off, else 0."""
        if isinstance(self.below_min_alpha, Tensor):
            return torch.where(alpha > self.below_min_alpha, alpha, 0.0)
        return torch.threshold(alpha, self.below_min_alpha, 0.0)


@runtime_checkable
class PixelKernel(Protocol):
    """Gives a splat's alpha at a pixel.

    m: splats; t: tiles; P: pixels per tile; p: pixels; c: columns of a raster row (`pixel_kernels.raster_rows`);
    *n: splats per tile, or nothing.

    name: unique among pixel kernels.
    columns: number of columns of a raster row.
    needs_depth_slopes: true if it draws discs, which need `Splats2D.depth_slopes`.
    splats_per_pass: splats of a tile that one compiled pass composites: a multiple of `forward.STEP`; 8 suits all but
        the cheapest kernels.  More compile slowly, fewer reload the pixels' state more often.
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
        """Splats whose cut-off ellipses contain every pixel centre where alpha > 0; None if the given ones do."""
        ...

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m_and_1 c"]:
        """One row per splat, with the colour and everything that `alpha` reads, then one padding row.

        Colours are differences from the background, and so may be negative.  The padding row's alpha is 0 everywhere:
        tiles that have run out of splats read it.  `raster_rows.rows_of` appends it.
        """
        ...

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """Alpha at each tile's pixels before the cap; 0 below the cut-off (`limits.cut`)."""
        ...

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p m 2"]) -> Float[Tensor, "p m"]:
        """The same formula in float64, by its definition: alpha / opacity at `offsets` (px), uncapped and uncut."""
        ...


@runtime_checkable
class ReadsRays(Protocol):
    """A pixel kernel that reads the ray of each pixel in `Splats2D.camera`, not its place."""

    def rays(
        self, splats: Splats2D, x: Float[Tensor, "*n"], y: Float[Tensor, "*n"]
    ) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
        """x, y and z of the rays of pixels at x and y px; all are 0 where nothing is seen."""
        ...


@runtime_checkable
class Compositor(Protocol):
    """Replaces 3DGS's alpha compositing.  t: tiles; P: pixels per tile; p: pixels, or entries of `order`."""

    @property
    def name(self) -> str: ...  # noqa: D102

    def rows(self, splats: Splats2D) -> Float[Tensor, "m c"]:
        """One row per splat, in a layout of its own; only `tiles` reads it."""
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
        """Premultiplied red, green, blue, and alpha; tile t composites `order[first[t] : first[t] + counts[t]]`.

        order: has at least one entry.
        centres: x and y of the pixel centres, in px.  window: `Splats2D.window`, in px.
        """
        ...

    def exact(
        self, splats: Splats2D, centres: Float[Tensor, "p 2"], rules: Rules
    ) -> tuple[Float[Tensor, "p 3"], Float[Tensor, " p"]]:
        """Float64 reference: premultiplied colour and transmittance (not alpha), for splats sorted nearest first."""
        ...


@runtime_checkable
class Rasterizer(Protocol):
    """Composites splats front to back over a background; splats of equal depth keep the given order.

    Front to back is by `Splats2D.depths`.
    """

    @property
    def name(self) -> str:
        """Name that users read."""
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
class RunsOwnKernels(Protocol):
    """A pixel kernel or compositor that runs kernels by itself, which `aaplug warmup` then compiles."""

    def kernels(self) -> tuple[Kernel, ...]:
        """These kernels."""
        ...


@runtime_checkable
class RunsKernels(Protocol):
    """A rasterizer that chooses how the elementwise stages before it run; without this they run eagerly."""

    @property
    def kernels(self) -> Kernels: ...  # noqa: D102


@runtime_checkable
class CountsEvaluations(Protocol):
    """A rasterizer that can count splat-pixel evaluations, a machine-independent cost of a frame."""

    def counting(self, add: Callable[[int], None]) -> Rasterizer:
        """The same rasterizer; after each pass it calls `add` with that pass's evaluations."""
        ...


@runtime_checkable
class SortsTiles(Protocol):
    """A rasterizer that sorts each tile's splats along its ray where they have `ray_slopes`.  tile: side in px."""

    tile: int


@runtime_checkable
class TakesMemory(Protocol):
    """A rasterizer whose working memory can be bounded."""

    def within(self, memory: float) -> Rasterizer:
        """The same rasterizer with a budget in bytes, beside the scene and the image."""
        ...
