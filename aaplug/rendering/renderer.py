"""The renderer: a scene that a recipe has prepared once, called with a camera.

    renderer = Renderer.of(scene, cameras)
    image = renderer(cameras.test[0].scaled(1 / 4)).rgb

This module holds the whole flow: world filter, projection, selection, screen filter, culling, shading, rasterization,
and weighing the samples of each pixel.  `Renderer.draw` lists the stages of a view, `Renderer._projected` those of its
splats.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from os import PathLike
from typing import Annotated, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet, Factor
from aaplug.core.colours import BLACK, Background, Colour, Share
from aaplug.core.conventions import MIN_SEEN_SHARE
from aaplug.core.ellipses import cull
from aaplug.core.exposures import frame_count, sample_cameras, spread_out
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import average_samples
from aaplug.core.interfaces import Compositor, Rasterizer, ReadsColumns, SortsTiles
from aaplug.core.kernels import Kernels
from aaplug.core.lenses import PINHOLE
from aaplug.core.light import lights
from aaplug.core.passes import PASSES, NormalAxes
from aaplug.core.projection import project, with_depth_slopes, with_ray_slopes
from aaplug.core.pyramids import Cutter, faded
from aaplug.core.sampling import sampling_bounds
from aaplug.core.shading import shade
from aaplug.core.splats import Render, Splats2D, concatenated
from aaplug.core.training import Margin, TrainingViews
from aaplug.io.cameras import read_cameras
from aaplug.io.images import colour_of
from aaplug.io.limits import lack_for_samples
from aaplug.io.scenes import SceneLike, scene_of
from aaplug.io.scenes.scene import Scene, SceneFrames, without_harmonics
from aaplug.methods.filters.matched import Matched
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.methods.pixel_kernels.ray import RAY, with_copies
from aaplug.methods.presets import find_recipe, suited
from aaplug.methods.recipe import RATE_TOLERANCE, Recipe
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.choice import CHANNELS, channels_at_once, find_rasterizer, kernels_of
from aaplug.rasterizers.tiled.order import Order, Shown
from aaplug.rendering.passes import by_order, composited, expected
from aaplug.system.contracts import Range, check_fields, contract
from aaplug.system.cores import on_free_cores
from aaplug.system.errors import UsageError, not_one_of, within_memory
from aaplug.system.plug_ins import asked, blaming, check_answer, filtered

GAUSSIANS_AT_ONCE = 1 << 20  # Gaussians projected at once, where no gradients are asked for
KEPT_RATES = 1 << 12  # free cameras whose rates a renderer remembers
LIGHT_PIXELS = 1 << 16  # of the view in which the light of an exposure's splats is looked up; fewer take no less time
RATE_DIGITS = 2  # decimals of the rate that sets the weight of neighbours, which so moves in steps
STRAIGHTENS = "`undistort` straightens cameras that distort"

Harmonics = Callable[[int, int], Float[Tensor, "c k 3"]]


class Drawing(NamedTuple):
    """A render, its splats, and the height and width in px of the supersampled image that they were drawn into."""

    render: Render
    splats: Splats2D
    hw: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Renderer:
    """A prepared scene; call it with a camera.

    scene: the Gaussians after the world filter.  training: the training views of the unfiltered ones.
    background: red, green, blue in [0, 1].
    harmonics: reads those of the Gaussians from start up to stop, where `scene.sh` does not hold them; else None.
    cutter: picks what a view draws where `scene` has several levels of detail; else None.
    source: the scene as it is stored, from which `by` and `trained_at` prepare it anew; None in other processes.
    in_time: the frames of a scene in time, of which `scene` is the first; else None.
    """

    scene: Gaussians = field(repr=False)
    training: TrainingViews = field(repr=False)
    recipe: Recipe
    rasterizer: Rasterizer = RASTERIZERS["eager"]
    background: Colour = BLACK
    harmonics: Harmonics | None = None
    cutter: Cutter | None = field(default=None, repr=False)
    source: Scene | None = None
    in_time: SceneFrames | None = None
    _rates: dict[tuple[object, ...], float] = field(default_factory=dict, init=False, repr=False)
    _open: dict[int, "Renderer"] = field(default_factory=dict, init=False, repr=False)  # of the last frame drawn

    def __post_init__(self) -> None:
        check_fields(self)
        if self.recipe.order == "tile" and not isinstance(self.rasterizer, SortsTiles):
            raise UsageError("rasterizer", f"{self.rasterizer.name} sorts by depth; order tile needs `SortsTiles`")

    @classmethod
    @contract
    def of(
        cls,
        scene: SceneLike,
        cameras: CameraSet | Sequence[Camera] | TrainingViews | str | PathLike[str],
        recipe: str | Recipe = "auto",
        *,
        quality: str = "balanced",
        background: Background = "auto",
        rasterizer: str | Rasterizer = "auto",
        cull_margin: Margin = math.inf,
        min_seen: Share = MIN_SEEN_SHARE,
    ) -> "Renderer":
        """Prepare a scene: check its frame, compute its sampling bounds and apply the world filter.

        Args:
            scene: a scene, its Gaussians or its path, before any world filter; its levels of detail are drawn if the
                recipe takes them.
            cameras: the training cameras, or their path.  With a `TrainingViews` nothing is checked or computed, and
                `cull_margin` and `min_seen` are ignored.
            recipe: a recipe, or its name in `RECIPES`.
            quality: "fast", "balanced" or "best": how finely recipe "auto" supersamples.
            background: a colour, in numbers or as CSS writes it, or "auto": that of the `CameraSet`, else black.
            rasterizer: a rasterizer, or its name: "auto" is "compiled" where `aaplug warmup` has run, else "eager".
            cull_margin: see `TrainingViews`.
            min_seen: share of the Gaussians that the cameras must see.

        Raises:
            FormatError: a file cannot be read.
            FrameError: the cameras see little of the scene.
            UsageError: a name is not known, there are no cameras, or the scene lacks what the recipe needs.
        """
        if isinstance(cameras, str | PathLike):
            cameras = read_cameras(cameras)
        if isinstance(recipe, str):
            recipe = find_recipe(recipe, quality=quality)
        source = scene_of(scene)
        pyramid = source.levels if recipe.levels else None
        gaussians, harmonics = (pyramid.scene, None) if pyramid else without_harmonics(source)
        if not isinstance(cameras, TrainingViews):
            training = TrainingViews.of(gaussians, cameras, cull_margin, min_seen)
            training = source.frames.over_all(training) if source.frames else training
        elif len(cameras.bounds.views) == len(gaussians):
            training = cameras
        else:  # of other levels of detail
            training = TrainingViews.of(gaussians, cameras.cameras, cameras.cull_margin)
        if isinstance(rasterizer, str):
            rasterizer = find_rasterizer(rasterizer)
        recipe = suited(recipe, gaussians)
        colour = background_colour(background, cameras)
        cutter = Cutter.of(pyramid, training) if pyramid else None
        filtered = recipe.prepared(gaussians, training)
        return cls(filtered, training, recipe, rasterizer, colour, harmonics, cutter, source, source.frames)

    @contract
    def by(self, recipe: Recipe) -> "Renderer":
        """The same scene by another recipe."""
        assert self.source is not None
        return Renderer.of(self.source, self.training, recipe, background=self.background, rasterizer=self.rasterizer)

    @contract
    def trained_at(self, factor: Factor) -> "Renderer":
        """The same scene as if training had sampled it `factor` times as finely; its world filter is applied anew."""
        training = self.training.finer(factor)
        cutter = None if self.cutter is None else Cutter.of(self.cutter.pyramid, training)
        if self.recipe.world is None:
            return replace(self, training=training, cutter=cutter)
        assert self.source is not None
        raw = without_harmonics(self.source)[0] if self.cutter is None else self.cutter.pyramid.scene
        return replace(self, scene=self.recipe.prepared(raw, training), training=training, cutter=cutter)

    @contract
    def showing(self, scene: Gaussians) -> "Renderer":
        """The same for another scene: its sampling bounds are computed from the same cameras."""
        training = TrainingViews.of(scene, self.training.cameras, self.training.cull_margin)
        return Renderer.of(scene, training, self.recipe, background=self.background, rasterizer=self.rasterizer)

    def portable(self) -> "Renderer":
        """The same for another process, without the scene's file, which may be open."""
        origin = self.scene.origin
        if origin is not None:  # rows stay where some of the file were dropped
            whole = torch.equal(origin.rows, torch.arange(len(origin.rows)))
            origin = None if whole else replace(origin, document=None)
        same = replace(self, scene=replace(self.scene, origin=origin), source=None)
        same._rates.update(self._rates)
        return same

    @contract
    def at(self, frame: Annotated[int, Range(0)]) -> "Renderer":
        """The renderer of one frame of a scene in time, by its place from 0; itself for any other scene.

        Raises:
            UsageError: there is no such frame, or it holds another number of Gaussians than the others.
        """
        if self.in_time is None or frame == 0:
            return self
        if frame >= len(self.in_time):
            raise UsageError("frame", f"expected one of 0 to {len(self.in_time) - 1}, got {frame}")
        now = self._open.get(frame)
        if now is None:
            self._open.clear()
            gaussians, harmonics = without_harmonics(self.in_time.open(self.in_time.paths[frame]))
            training = self.in_time.training_of(gaussians, self.training)
            scene = self.recipe.prepared(gaussians, training)
            now = replace(self, scene=scene, training=training, harmonics=harmonics, source=None, in_time=None)
            self._open[frame] = now  # which another thread may clear
        return now

    @contract
    @on_free_cores()
    def __call__(self, camera: Camera) -> Render:
        """Render one view: rgb and alpha of `camera.hw`; with an exposure, the mean of its frames.

        Differentiable once, in every parameter of the scene and in `camera.cam_from_world`; a motion has its own poses.

        Raises:
            UsageError: a Gaussian in view has a colour that is NaN or infinite, or memory does not suffice.
        """
        with within_memory(f"view {camera.name} at {camera.width}x{camera.height}"):
            return self.draw(camera).render

    @contract
    @on_free_cores()
    def draw(self, camera: Camera) -> Drawing:
        """Render one view and keep its splats, of an exposure its last frame's, for example to read their gradients."""
        if (now := self.at(camera.frame)) is not self:
            return now.draw(camera)
        samples, weight = self.sampling(camera)
        fine = self._fine(camera, samples)
        light, render, splats = self._light(fine, samples), None, None
        for each in sample_cameras(fine):
            splats = None  # the former frame's are freed before the next are made
            splats = self.splats(each, samples, light)
            image = self.paint(splats, fine.hw)
            pixels = average_samples(image, samples, weight)
            render = pixels if render is None else Render(*map(torch.add, render, pixels))
        assert render is not None
        assert splats is not None
        if (count := frame_count(fine)) > 1:
            render = Render(render.rgb / count, render.alpha / count)
        return Drawing(render, splats, fine.hw)

    def _fine(self, camera: Camera, samples: int) -> Camera:
        """The camera of the supersampled image; raises UsageError where memory does not suffice."""
        width, height = camera.width * samples, camera.height * samples
        if lacking := lack_for_samples(width * height):
            problem = f"with {samples}×{samples} samples per pixel would take {lacking}; a smaller image needs less"
            raise UsageError(f"view {camera.name} at {camera.width}x{camera.height}", problem)
        return camera if samples == 1 else camera.resized(width, height)

    @contract
    @torch.no_grad()
    @on_free_cores()
    def passes(
        self, camera: Camera, names: Sequence[str], normal_axes: NormalAxes = "camera"
    ) -> dict[str, Float[Tensor, "h w ..."] | Int[Tensor, "h w"]]:
        """Render passes of one view by name, such as depth and normal, without gradients.

        `aaplug guide film` and `rendering.passes` state how each is resolved.  rgb is over the background, as alpha it
        is [h, w].  Lengths are in world units; an id is the Gaussian's place in the scene's file, with levels of detail
        its place in all of them, finest first.  All but rgb and alpha are of an instant, through a lens without a size.

        normal_axes: of normals: "world"; or "camera": x right, y up, z towards the viewer.

        Raises:
            UsageError: there is no such pass; see `__call__`.
        """
        for name in names:
            if name not in PASSES:
                raise UsageError("passes", not_one_of(name, PASSES))
        if (now := self.at(camera.frame)) is not self:
            return now.passes(camera, names, normal_axes)
        if {*names} <= {"rgb", "alpha"}:
            image = self(camera)._asdict()
            return {name: image[name] for name in names}
        with within_memory(f"view {camera.name} at {camera.width}x{camera.height}"):
            exposed = None if camera.exposure is None else self(camera)
            camera = replace(camera, exposure=None)
            render, splats, hw = self.draw(camera)
            found: dict[str, Tensor] = (exposed or render)._asdict()
            samples, weight = self.sampling(camera)
            fine = self._fine(camera, samples)
            recipe = self.recipe_through(splats.camera)
            per_call = [CHANNELS] if recipe.compositor else channels_at_once(self.rasterizer, recipe.pixel)
            paint = partial(self.paint, hw=hw, background=BLACK)
            draw = partial(composited, splats, draw=paint, per_call=per_call)
            found |= expected(names, splats, self.scene, self.training.bounds, fine, samples, weight, normal_axes, draw)

            def draw_by_order(numbered: Splats2D, shown: Shown) -> Render:
                return paint(numbered, compositor=Order.of(recipe.pixel, shown, numbered))

            found |= by_order(names, splats, samples, draw_by_order)
            if "id" in found and self.scene.origin is not None:
                rows = self.scene.origin.rows.to(found["id"].device)
                found["id"] = torch.where(found["id"] < 0, found["id"], rows[found["id"]])
        return {name: found[name] for name in names}

    @contract
    @on_free_cores()
    def paint(
        self,
        splats: Splats2D,
        hw: tuple[int, int],
        background: Colour | None = None,
        compositor: Compositor | None = None,
    ) -> Render:
        """Composite coloured splats into an image of height and width `hw` px.

        background: None for the renderer's own.  compositor: instead of the recipe's.
        """
        colour = self.background if background is None else background
        recipe, rules = self.recipe_through(splats.camera), self.training.convention.rules
        if compositor is not None:
            recipe = replace(recipe, compositor=compositor)
        with blaming(*recipe.parts, ("rasterizer", self.rasterizer)) as plug_ins:
            image = self.rasterizer(splats, hw, colour, recipe.pixel, recipe.compositor, rules)
            if plug_ins:
                check_answer(f"rasterizer {self.rasterizer.name}", image, Render)
                expected = {"rgb": [*hw, splats.rgb.shape[1] if splats.rgb is not None else 0], "alpha": [*hw]}
                for name, value in image._asdict().items():
                    if [*value.shape] != expected[name]:
                        raise UsageError(name, f"expected {expected[name]}, got {[*value.shape]}")
                    if not value.isfinite().all():
                        raise UsageError(name, "expected finite numbers, got some that are NaN or infinite")
        return image

    def recipe_through(self, camera: Camera | None) -> Recipe:
        """The recipe, which draws splats on rays if the camera's lens is no pinhole."""
        if camera is None or camera.lens == PINHOLE:
            return self.recipe
        if self.recipe.order == "tile":
            raise UsageError("order", f"tile is for pinhole views; depth draws all, and {STRAIGHTENS}")
        if self.recipe.pixel != POINT or self.recipe.compositor is not None:
            problem = f"recipe {self.recipe.name} draws pinhole views only"
            raise UsageError("lens", f"{problem}; auto, matched, classic, ewa and mip draw all, and {STRAIGHTENS}")
        return replace(self.recipe, pixel=RAY)

    @contract
    def sampled(self, camera: Camera) -> tuple[Camera, int]:
        """Camera of the supersampled image, and the samples along a pixel's side."""
        samples = self.samples(camera)
        return self._fine(camera, samples), samples

    def samples(self, camera: Camera) -> int:
        """Number of samples along a pixel's side, in each frame of an exposure."""
        return self.sampling(camera)[0]

    @contract
    def sampling(self, camera: Camera, samples: int | None = None) -> tuple[int, float]:
        """Samples along a pixel's side, and the weight of those on either side of each; constants to gradients.

        The frames of an exposure share the pixel: in all they have at least the recipe's samples, and no neighbours.

        samples: of each frame, instead of the recipe's number.
        """
        recipe, frames = self.recipe, frame_count(camera)
        weighs = recipe.neighbours > 0 and self.cutter is None and frames == 1
        rate = self.relative_rate(camera) if weighs or (samples is None and recipe.target_rate) else 1.0
        if samples is None:
            samples = recipe.samples_at(rate) if recipe.target_rate else recipe.grid
            if recipe.target_rate and self.cutter is not None and recipe.levels is not None:
                for_coarsest = math.ceil(0.5 ** (len(self.cutter.pyramid) - 1) / rate - RATE_TOLERANCE)
                samples = int(min(samples, max(recipe.levels.most_samples, for_coarsest)))
            samples = math.ceil(samples / math.sqrt(frames) - RATE_TOLERANCE)
        sampled_rate = max(10**-RATE_DIGITS, round(samples * rate, RATE_DIGITS))
        return samples, recipe.neighbours_at(sampled_rate) if weighs else 0.0

    @contract
    def coarsening(self, camera: Camera, samples: int) -> float:
        """Octaves by which levels of detail are coarser than those of the samples; see `Cutter.coarsening`."""
        choice = self.recipe.levels
        if self.cutter is None or choice is None:
            return 0.0
        most = max(choice.budget, int(choice.share * self.cutter.pyramid.sizes[0]))
        return self.cutter.coarsening(camera, max(0.0, math.log2(samples) - choice.finer), most)

    @contract
    def relative_rate(self, camera: Camera) -> float:
        """A view's sampling rate relative to training, which sets the samples per pixel.

        At a data-set pose it is the ratio of focal lengths.  For a free camera, which may be nearer or farther than
        any training camera, it is the median over visible Gaussians of (rate now / nearest rate in the Gaussian's
        training range); without any, and for a recipe that compares with "global", the ratio of focal lengths.
        """
        screen = self.recipe.screen
        if camera.trained_focal is not None or (isinstance(screen, Matched) and screen.reference == "global"):
            return self.training.relative_rate(camera)
        key = (camera.lens, *camera.intrinsics, camera.cam_from_world.detach().cpu().numpy().tobytes())
        rate = self._rates.get(key)
        if rate is None:
            rate = self._median_rate(camera)
            if len(self._rates) >= KEPT_RATES:
                self._rates.clear()
            self._rates[key] = rate
        return rate

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

    @contract
    @on_free_cores()
    def splats(self, camera: Camera, samples: int = 1, light: Float[Tensor, " n"] | None = None) -> Splats2D:
        """The splats of one view: projected, selected, filtered, culled and coloured.

        Without gradients, Gaussians pass in chunks, and memory is bounded by a chunk and by the splats that stay.

        samples: along a pixel's side, if `camera` is that of the supersampled image.
        light: factors of the Gaussians' opacities where its exposure spreads them, see `lights`; None for 1.
        """
        cut = None if self.cutter is None else self.cutter(camera, self.coarsening(camera, samples))
        whole, parts = max(1, len(self.scene) if cut is None else len(cut)), []
        at_once = whole if self.scene.tracked else GAUSSIANS_AT_ONCE
        for start in range(0, whole, at_once):
            if cut is not None:
                part = cut[start : start + at_once]
                chunk, places, shares = part.of(self.scene), part.places, part.shares
            else:
                chunk, places = self.scene if whole <= at_once else self.scene[start : start + at_once], start
                shares = None
            splats = self._projected(chunk, places, shares, camera, light)
            if self.harmonics is None or not len(splats):
                parts.append(shade(splats, self.scene, camera, self.kernels))
                continue
            chunk = replace(chunk, sh=self.harmonics(start, start + len(chunk)))
            local = splats.with_columns({"sources": splats.sources - start})
            parts.append(shade(local, chunk, camera, self.kernels).with_columns({"sources": splats.sources}))
        splats = concatenated(parts)
        if self.recipe.order == "tile":
            splats = with_ray_slopes(splats, self.scene, camera)
        colours = splats.rgb
        assert colours is not None
        if not colours.sum().isfinite() and (bad := ~colours.isfinite().all(dim=1)).any():
            first, count = int(splats.sources[bad].min()), int(bad.sum())
            raise UsageError(f"Gaussian {first}", f"has no finite colour (the first of {count})")
        return with_copies(splats, self.training.convention.rules)

    @torch.inference_mode(False)
    @torch.no_grad()
    def _light(self, fine: Camera, samples: int) -> Float[Tensor, " n"] | None:
        """The factor of each Gaussian's opacity where the exposure of a view spreads it; see `lights`.

        It is looked up in a small view of the exposure's middle; Gaussians beside it have the mean.  A compositor has a
        rule of its own for what a splat hides, and does without.
        """
        if self.recipe.compositor is not None or fine.exposure is None:
            return None
        [middle] = sample_cameras(replace(fine, exposure=replace(fine.exposure, samples=1)))
        small = replace(middle, exposure=fine.exposure)
        if self.cutter is None:  # else a small view would show coarser levels of detail
            small = small.scaled(min(1 / samples, math.sqrt(LIGHT_PIXELS / (small.width * small.height))))
            samples = 1
        splats, paint = self.splats(replace(small, exposure=None), samples), partial(self.paint, hw=small.hw)
        found = lights(splats, small, self.training.convention.rules.min_alpha, partial(paint, background=BLACK))
        beside, originals = float(found.mean().nan_to_num(1.0)), ~splats.are_copies
        return found.new_full((len(self.scene),), beside).index_copy_(0, splats.sources[originals], found[originals])

    def _projected(
        self,
        chunk: Gaussians,
        places: Int[Tensor, " m"] | int,
        shares: Float[Tensor, " m"] | None,
        camera: Camera,
        light: Float[Tensor, " n"] | None,
    ) -> Splats2D:
        """Splats of some Gaussians, without colour.

        places: of each in the scene, or of the first if all follow.  shares: see `Cut`.
        """
        recipe, training, kernels = self.recipe_through(camera), self.training, self.kernels
        rules = training.convention.rules
        splats = project(chunk, camera, kernels, rules, clamped=not recipe.pixel.needs_depth_slopes)
        if recipe.selection is not None:
            splats = asked("selection", recipe.selection, "__call__", splats, chunk)
        if recipe.pixel.needs_depth_slopes:
            splats = with_depth_slopes(splats, chunk, camera)
        own, screen = splats.sources, recipe.screen
        if isinstance(screen, ReadsColumns):
            found = {name: chunk.extras[name] for name in screen.columns if name in chunk.extras}
            screen = screen.reading({name: column.index_select(0, own) for name, column in found.items()})
        if not isinstance(places, int):
            splats = replace(splats, sources=places.index_select(0, own))
        elif places:
            splats = replace(splats, sources=own + places)
        splats = filtered("screen filter", screen, splats, camera, training)
        if shares is not None:
            splats = faded(splats, shares.index_select(0, own))
        if camera.exposure is not None:
            splats, _ = spread_out(splats, camera, None if light is None else light.index_select(0, splats.sources))
        ellipses = asked("pixel kernel", recipe.pixel, "bounding_ellipses", splats, rules)
        splats = splats.bounded_by(ellipses, recipe.pixel, rules)
        return cull(splats, camera.hw, training.cull_margin, kernels, ellipses, rules)

    @property
    def kernels(self) -> Kernels:
        """The kernels that run the stages before the rasterizer, as it runs its own."""
        return kernels_of(self.rasterizer)


def own_look(
    scene: SceneLike,
    cameras: CameraSet | TrainingViews,
    rasterizer: str | Rasterizer = "auto",
    background: Background = "auto",
    cull_margin: Margin = math.inf,
    min_seen: Share = 0.0,
) -> Renderer:
    """A renderer of the scene by training's own rule, at any size (recipe `matched`); its finest level alone.

    2D Gaussians are drawn as discs, by `2dgs-matched` with one sample per pixel.  Arguments and errors: see
    `Renderer.of`.
    """
    recipe = replace(find_recipe("matched"), for_discs=find_recipe("auto").for_discs)
    drawn = {"rasterizer": rasterizer, "background": background}
    return Renderer.of(scene, cameras, recipe, **drawn, cull_margin=cull_margin, min_seen=min_seen)


@contract
def background_colour(background: Background, cameras: object = None) -> Colour:
    """The colour behind the scene; raises UsageError if CSS knows no such colour."""
    if background == "auto":
        return (cameras.background if isinstance(cameras, CameraSet) else None) or BLACK
    red, green, blue = colour_of(background) if isinstance(background, str) else background
    return red, green, blue
