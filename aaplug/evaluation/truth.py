"""The truth: the image that a view should show at a scale.

It comes from one larger image: the photograph, or the scene's own look at the training size.  Below that size the
truth is this image averaged down.  Above it, the truth is the scene's own supersampled look, an estimate (`Enlarge`),
or undefined.  Where a protocol moves the camera, the truth is the scene's own supersampled look from there.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.errors import UsageError
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import quantised, resampled
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.evaluation.metric import Drawn, Image, TimedRenderer
from aaplug.evaluation.protocols import PROTOCOLS, Protocol, TruthSource, median_depth
from aaplug.evaluation.upsamplers import Upsampler, bicubic
from aaplug.io.photographs import DOWNSCALES, Photograph
from aaplug.methods.recipe import Recipe
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.renderer import Background, Renderer

NO_PHOTOGRAPH = "has no photograph to compare with; truth 'self' compares with the scene's own look"
MEMORY = 1e9  # bytes of images to keep; what does not fit is made again each time
KEPT = torch.float16  # 11 significant bits, against the 8 that are compared

Larger = Float[Tensor, "H W 3"]
Enlarge = Callable[[Renderer, Image, Camera], Larger]  # own look, image at hand, larger camera


def own_look(
    scene: Gaussians, training: TrainingViews, rasterizer: str | Rasterizer = "auto", background: Background = "auto"
) -> Renderer:
    """The scene as training showed it, at any size."""
    return Renderer.of(scene, training, find_recipe("matched"), rasterizer=rasterizer, background=background)


def back_projected(own: Renderer, full: Image, camera: Camera) -> Larger:
    """The scene's own render, corrected so that its averages are the image at hand (Irani and Peleg 1991)."""
    with torch.no_grad():
        image = own(camera).rgb.clamp(0.0, 1.0)
    averages = resampled(image, full.shape[1] / camera.width, (full.shape[0], full.shape[1]))
    return image + bicubic(full - averages, camera.hw)


def upsampled(upsampler: Upsampler) -> Enlarge:
    """The image at hand, enlarged by an upsampler."""
    return lambda own, full, camera: upsampler(full, camera.hw)


def source_of(views: Sequence[Camera], asked: str = "auto") -> TruthSource:
    """The source that is asked for; for "auto" photographs where every view has one, else the own look.

    Raises UsageError if there is no source of that name, or a view has no photograph.
    """
    missing = [view.name for view in views if view.photo is None]
    if asked == "self" or (asked == "auto" and missing):
        return "self"
    if asked not in ("auto", "photographs"):
        raise UsageError("truth", f"'{asked}' is not one of auto, photographs, self")
    if missing:
        raise UsageError(missing[0], NO_PHOTOGRAPH)
    return "photographs"


@dataclass(frozen=True)
class Truth:
    """The images to compare with.

    own: see `own_look`.
    enlarge: makes the truth above the size of the larger image.  None: the scene's own look with as many samples as
        reach training's rate; with photographs there is no truth.
    memory: bytes of images to keep, in float16, for calls that come again and again; None keeps none and rounds none.
    """

    own: Renderer
    source: TruthSource = "self"
    protocol: Protocol = PROTOCOLS["default"]
    enlarge: Enlarge | None = None
    memory: float | None = None
    _kept: dict[tuple[object, ...], Tensor] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __call__(self, view: Camera, scale: float) -> Image:
        """The image of a view, given at the training size, at a scale where there is a truth."""
        image = ViewTruth(self, view).image(scale)
        assert image is not None
        return image

    @cached_property
    def timed(self) -> TimedRenderer:
        """The scene's own look."""
        return TimedRenderer(self.own)

    def remembered(self, view: Camera, scale: float, make: Callable[[], Image | None]) -> Image | None:
        """The image that is kept, or a new one, kept while there is room."""
        if self.memory is None:
            return make()
        pose = view.cam_from_world.detach().cpu().numpy().tobytes()  # names recur in other splits
        key = *view.intrinsics, pose, scale
        if key in self._kept:
            return self._kept[key].float()
        made = make()
        if made is None:
            return None
        image = made.to(KEPT)
        if sum(kept.nbytes for kept in self._kept.values()) + image.nbytes <= self.memory:
            self._kept[key] = image
        return image.float()


class ViewTruth:
    """The truth of one view.  Its photograph is read, and its training-size look drawn, at most once and on demand."""

    def __init__(self, truth: Truth, view: Camera):
        self.truth, self.view = truth, view
        self._motions: dict[float, list[Tensor]] = {}

    def camera(self, scale: float) -> Camera:
        """The view at a scale."""
        return self.truth.protocol.camera(self.view, scale, self._depth)

    @cached_property
    def look(self) -> Drawn:
        """The scene's own look at the training size."""
        return self.truth.timed(self.view)

    def resized_look(self, scale: float) -> Image:
        """The training-size look, averaged down (bicubic above scale 1)."""
        return self.truth.protocol.resized(self.look.rgb.clamp(0, 1), self.camera(scale), scale)

    def compared(self, scale: float) -> Image | None:
        """The image that renders are compared with, in 8 bits as photographs are; None where there is no truth."""
        image = self.image(scale)
        rounds = self.truth.source == "self" or self.truth.memory is not None
        return quantised(image) if image is not None and rounds else image

    def image(self, scale: float) -> Image | None:
        """The truth at a scale, before rounding; None where there is none."""
        return self.truth.remembered(self.view, scale, lambda: self._made(scale))

    def motion(self, scale: float) -> list[Image]:
        """The training-size look, averaged down, as it moves by steps of 1/4 px of the smaller image."""
        if scale not in self._motions:
            camera, frames = self.camera(scale), self.truth.timed.motion(self.view, scale)
            self._motions[scale] = [self.truth.protocol.resized(frame, camera, scale) for frame in frames]
        return self._motions[scale]

    def _made(self, scale: float) -> Image | None:
        truth, camera = self.truth, self.camera(scale)
        if truth.protocol.change != "size":
            samples = max(1, math.ceil(1 / scale))  # as dense as training's pixels
            return self._shown(camera, replace(truth.own.recipe, grid=samples))
        if truth.source == "photographs":
            factor = scale * self.view.width / self._photograph.hw[1]
            if factor <= 1:
                return self._photograph.at(camera.hw, factor)
        elif truth.own.training.relative_rate(camera) <= 1:
            return self.resized_look(scale)
        if truth.enlarge is not None:
            photographed = truth.source == "photographs"
            full = self._photograph.at(self._photograph.hw, 1.0) if photographed else self.look.rgb.clamp(0.0, 1.0)
            return truth.enlarge(truth.own, full, camera).clamp(0.0, 1.0)
        return None if truth.source == "photographs" else self._shown(camera, find_recipe("auto", quality="best"))

    @cached_property
    def _photograph(self) -> Photograph:
        assert self.view.photo is not None
        downscale = DOWNSCALES[self.truth.protocol.downscale]
        return downscale.read(self.view.photo, self.truth.own.background, self.view.lens)

    @cached_property
    def _depth(self) -> float:
        """Median depth of the scene in the view, in world units; needed only where the distance changes."""
        if self.truth.protocol.change != "distance":
            return 1.0
        return median_depth(self.truth.own.scene.means, self.view)

    def _shown(self, camera: Camera, recipe: Recipe) -> Image:
        """The scene by a recipe."""
        return TimedRenderer(replace(self.truth.own, recipe=recipe))(camera).rgb
