"""The renderer: a scene that a recipe has prepared once, called with a camera.

    renderer = Renderer.of(scene, cameras)
    image = renderer(cameras.test[0].scaled(1 / 4)).rgb

This module holds the whole flow: world filter, projection, selection, screen filter, culling, shading, rasterization,
and weighing the samples of each pixel.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import BLACK, WHITE, Camera, CameraSet
from aaplug.core.choices import MIN_SEEN_SHARE, Background, Colour
from aaplug.core.culling import cull
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import average_samples
from aaplug.core.interfaces import Rasterizer, RunsKernels
from aaplug.core.kernels import EAGER, Kernels
from aaplug.core.projection import project, with_depth_slopes
from aaplug.core.pyramids import Cutter, Pyramid, faded
from aaplug.core.sampling import sampling_bounds
from aaplug.core.shading import shade
from aaplug.core.splats import Render, Splats2D, concatenated
from aaplug.core.training import TrainingViews
from aaplug.methods.filters import fuse_stored
from aaplug.methods.recipe import SLACK, Recipe
from aaplug.methods.recipes import find_recipe, suited
from aaplug.rasterizers import RASTERIZERS, find_rasterizer

CHUNK = 1 << 20  # Gaussians projected at once, where no gradients are asked for
RATE_DIGITS = 2  # decimals of the rate that sets the weight of neighbours, which so moves in steps

Harmonics = Callable[[int, int], Float[Tensor, "c k 3"]]


class Drawing(NamedTuple):
    """A render, its splats, and the height and width in px of the supersampled image that they were drawn into."""

    render: Render
    splats: Splats2D
    hw: tuple[int, int]


@dataclass(frozen=True)
class Renderer:
    """A prepared scene; call it with a camera.

    scene: the scene after the world filter.  training: the training views of the unfiltered scene.
    background: red, green, blue in [0, 1].
    harmonics: reads those of the Gaussians from start up to stop, where `scene.sh` does not hold them; else None.
    cutter: picks what a view draws where `scene` has several levels of detail; else None.
    """

    scene: Gaussians
    training: TrainingViews
    recipe: Recipe
    rasterizer: Rasterizer = RASTERIZERS["eager"]
    background: Colour = BLACK
    harmonics: Harmonics | None = None
    cutter: Cutter | None = None
    _rates: dict[tuple[object, ...], float] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        scene: Gaussians | Pyramid,
        cameras: CameraSet | Sequence[Camera] | TrainingViews,
        recipe: str | Recipe = "auto",
        *,
        quality: str = "balanced",
        background: Background = "auto",
        rasterizer: str | Rasterizer = "auto",
        cull_margin: float = math.inf,
        min_seen: float = MIN_SEEN_SHARE,
    ) -> "Renderer":
        """Prepare a scene: check its frame, compute its sampling bounds and apply the world filter.

        Args:
            scene: the scene as its file stores it, before any world filter; or a pyramid, whose levels are drawn if
                the recipe takes them.
            cameras: the training cameras.  With a `TrainingViews` nothing is checked or computed, and `cull_margin`
                and `min_seen` are ignored.
            recipe: a recipe, or its name in `RECIPES`.
            quality: "fast", "balanced" or "best": how finely recipe "auto" supersamples.
            background: a colour, "white", "black", or "auto": the colour that a `CameraSet` records, else black.
            rasterizer: a rasterizer, or its name: "auto" is "compiled" where `aaplug warmup` has run, else "eager".
            cull_margin: see `TrainingViews`.
            min_seen: share of the Gaussians that the cameras must see.

        Raises:
            FrameError: the cameras see little of the scene.
            UsageError: a name is not known, there are no cameras, or the scene lacks what the recipe needs.
        """
        if isinstance(recipe, str):
            recipe = find_recipe(recipe, quality=quality)
        pyramid = None
        if isinstance(scene, Pyramid):
            pyramid = scene if recipe.levels else None
            scene = scene.scene if pyramid else scene.finest
        if isinstance(cameras, TrainingViews):
            training = cameras if pyramid is None else TrainingViews.of(scene, cameras.cameras, cameras.cull_margin)
        else:
            training = TrainingViews.of(scene, cameras, cull_margin, min_seen)
        if isinstance(rasterizer, str):
            rasterizer = find_rasterizer(rasterizer)
        recipe = suited(recipe, scene)
        colour = background_colour(background, cameras)
        cutter = Cutter.of(pyramid, training) if pyramid else None
        return cls(prepared(scene, training, recipe), training, recipe, rasterizer, colour, cutter=cutter)

    def showing(self, scene: Gaussians) -> "Renderer":
        """The same for another scene: its sampling bounds are computed from the same cameras."""
        known = self.training
        training = TrainingViews.of(scene, known.cameras, known.cull_margin)
        filtered = prepared(scene, training, self.recipe)
        return replace(self, scene=filtered, training=training, harmonics=None, cutter=None)

    def __call__(self, camera: Camera) -> Render:
        """Render one view: rgb and alpha of `camera.hw`.

        Differentiable in every parameter of the scene and in `camera.cam_from_world`.

        Raises:
            UsageError: a Gaussian in view has a colour that is NaN or infinite.
        """
        return self.draw(camera).render

    def draw(self, camera: Camera) -> Drawing:
        """Render one view and keep its splats, for example to read their gradients."""
        fine, samples = self.sampled(camera)
        splats = self.splats(fine, samples)
        recipe, rules = self.recipe, self.training.convention.rules
        image = self.rasterizer(splats, fine.hw, self.background, recipe.pixel, recipe.compositor, rules)
        return Drawing(average_samples(image, samples, self.neighbours(camera)), splats, fine.hw)

    def sampled(self, camera: Camera) -> tuple[Camera, int]:
        """Camera of the supersampled image, and the samples along a pixel's side."""
        samples = self.samples(camera)
        return _sampled(camera, samples), samples

    def samples(self, camera: Camera) -> int:
        """Number of samples along a pixel's side."""
        if self.recipe.target_rate == 0:
            return self.recipe.grid
        rate = self.relative_rate(camera)
        asked = self.recipe.samples_at(rate)
        if self.cutter is None or self.recipe.levels is None:
            return asked
        for_coarsest = math.ceil(self.cutter.pyramid.coarsest_rate / rate - SLACK)
        return int(min(asked, max(self.recipe.levels.most_samples, for_coarsest)))

    def coarsening(self, camera: Camera, samples: int) -> float:
        """Octaves by which levels of detail are coarser than those of the samples; see `Cutter.coarsening`."""
        choice = self.recipe.levels
        if self.cutter is None or choice is None:
            return 0.0
        most = max(choice.budget, int(choice.share * self.cutter.pyramid.sizes[0]))
        return self.cutter.coarsening(camera, max(0.0, math.log2(samples) - choice.finer), most)

    def neighbours(self, camera: Camera) -> float:
        """Weight of the samples on either side of each sample: like their number, a constant to gradients."""
        if self.recipe.neighbours == 0 or self.cutter is not None:
            return 0.0
        sampled_rate = self.samples(camera) * self.relative_rate(camera)
        return self.recipe.neighbours_at(round(sampled_rate, RATE_DIGITS))

    def relative_rate(self, camera: Camera) -> float:
        """A view's sampling rate relative to training, which sets the samples per pixel.

        At a data-set pose it is the ratio of focal lengths.  For a free camera, which may be nearer or farther than
        any training camera, it is the median over visible Gaussians of (rate now / nearest rate in the Gaussian's
        training range); without any, the ratio of focal lengths.
        """
        if camera.trained_focal is not None:
            return self.training.relative_rate(camera)
        key = (*camera.intrinsics, camera.cam_from_world.detach().cpu().numpy().tobytes())
        if key not in self._rates:
            self._rates[key] = self._median_rate(camera)
        return self._rates[key]

    @torch.no_grad()
    def _median_rate(self, camera: Camera) -> float:
        for part in [slice(None)] if self.cutter is None else reversed(self.cutter.pyramid.places):
            bounds = self.training.bounds[part]
            now = sampling_bounds(self.scene.means[part], [camera]).highest
            both = (now > 0) & bounds.seen
            if both.any():
                now, lowest, highest = (x[both] for x in (now, bounds.lowest, bounds.highest))
                return float((now / torch.minimum(torch.maximum(now, lowest), highest)).median())
        return self.training.relative_rate(camera)

    def splats(self, camera: Camera, samples: int = 1) -> Splats2D:
        """The splats of one view: projected, selected, filtered, culled and coloured.

        Without gradients, Gaussians pass in chunks, and memory is bounded by a chunk and by the splats that stay.

        samples: along a pixel's side, if `camera` is that of the supersampled image.
        """
        cut = None if self.cutter is None else self.cutter(camera, self.coarsening(camera, samples))
        whole, parts = max(1, len(self.scene) if cut is None else len(cut)), []
        at_once = whole if self.scene.tracked else CHUNK
        for start in range(0, whole, at_once):
            if cut is not None:
                part = cut[start : start + at_once]
                chunk, places, shares = part.of(self.scene), part.places, part.shares
            else:
                chunk, places = self.scene if whole <= at_once else self.scene[start : start + at_once], start
                shares = None
            splats = self._projected(chunk, places, shares, camera)
            parts.append(self._shaded(splats, chunk, start, camera))
        splats = concatenated(parts)
        _check_colours(splats)
        return splats

    def _projected(
        self, chunk: Gaussians, places: Int[Tensor, " m"] | int, shares: Float[Tensor, " m"] | None, camera: Camera
    ) -> Splats2D:
        """Splats of some Gaussians, without colour.

        places: of each in the scene, or of the first if all follow.  shares: see `Cut`.
        """
        recipe, training, kernels = self.recipe, self.training, self._kernels
        rules = training.convention.rules
        splats = project(chunk, camera, kernels, rules)
        if recipe.selection is not None:
            splats = recipe.selection(splats, chunk)
        if recipe.pixel.needs_depth_slopes:
            splats = with_depth_slopes(splats, chunk, camera)
        own = splats.sources
        splats = replace(splats, sources=own + places if isinstance(places, int) else places.index_select(0, own))
        splats = recipe.screen(splats, camera, training)
        if shares is not None:
            splats = faded(splats, shares.index_select(0, own))
        ellipses = recipe.pixel.bounding_ellipses(splats, rules)
        return cull(splats, camera.hw, training.cull_margin, kernels, ellipses, rules)

    def _shaded(self, splats: Splats2D, chunk: Gaussians, start: int, camera: Camera) -> Splats2D:
        """The same splats with colour; harmonics that the scene does not hold are read for the chunk from `start`."""
        if self.harmonics is None or not len(splats):
            return shade(splats, self.scene, camera, self._kernels)
        chunk = replace(chunk, sh=self.harmonics(start, start + len(chunk)))
        local = replace(splats, sources=splats.sources - start)
        return replace(shade(local, chunk, camera, self._kernels), sources=splats.sources)

    @property
    def _kernels(self) -> Kernels:
        return self.rasterizer.kernels if isinstance(self.rasterizer, RunsKernels) else EAGER


def _sampled(camera: Camera, samples: int) -> Camera:
    """Camera of the image with so many samples along a pixel's side."""
    return camera.resized(camera.width * samples, camera.height * samples)


def prepared(scene: Gaussians, training: TrainingViews, recipe: Recipe) -> Gaussians:
    """Apply what acts once per scene: its stored 3D filter, which is part of it, then the recipe's world filter.

    A world filter is applied even if the scene already contains one: use `mip` if it stores `filter_3D`.
    """
    scene = fuse_stored(scene)
    return scene if recipe.world is None else recipe.world(scene, training)


def background_colour(background: Background, cameras: object = None) -> Colour:
    """The colour behind the scene.

    Raises:
        UsageError: the name is not known.
    """
    if not isinstance(background, str):
        return background
    named: dict[str, Colour] = {"white": WHITE, "black": BLACK}
    if background == "auto":
        found = cameras.background if isinstance(cameras, CameraSet) else None
        return found or BLACK
    if background not in named:
        raise UsageError("background", f"expected auto, white, black or a colour, got '{background}'")
    return named[background]


def _check_colours(splats: Splats2D) -> None:
    """Raise on NaN or infinite colours, which would contaminate every pixel that they touch."""
    colours: Tensor | None = splats.rgb
    assert colours is not None
    if not colours.sum().isfinite():
        bad = ~colours.isfinite().all(dim=1)
        if bad.any():
            first, count = int(splats.sources[bad].min()), int(bad.sum())
            raise UsageError(f"Gaussian {first}", f"has no finite colour (the first of {count})")
