"""Ground truth: the image that a view should show at a scale.

Its source image is the photograph, or the scene's own render at the training size.  Up to the source's size, ground
truth is the source downsampled.  Above it, ground truth is the estimate of `enlarge`, if one is given; else the scene's
own render at that size, or, with photographs, undefined.  Where a protocol moves the camera or changes its focal
length, ground truth is the scene's own render of that view, supersampled where it is coarser than training.

Where scenes are compared, ground truth is one of them, the reference, as its own recipe draws it at each scale.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import median_depth
from aaplug.core.cameras import Camera
from aaplug.core.imaging import levels, quantised, resampled
from aaplug.evaluation import PROTOCOLS
from aaplug.evaluation.metric import Image, TimedImage, TimedRenderer
from aaplug.evaluation.protocols import Protocol, TruthSource
from aaplug.evaluation.upsamplers import Upsampler, bicubic
from aaplug.io.photographs import DOWNSCALES, Photograph
from aaplug.methods.presets import find_recipe
from aaplug.rendering.renderer import Renderer
from aaplug.system.errors import UsageError

NO_PHOTOGRAPH = "has no photograph; `truth` self compares with the scene's own render"
MEMORY = 1e9  # bytes of images to cache; what does not fit is made again each time
CACHE_DTYPE, CACHE_BITS = torch.uint16, 16  # 8-bit images are the same when rounded from 16 bits: 65535 is 257 x 255
SLAB_SIZE = 1 << 25  # numbers of the cache allocated at once: 64 MB

Larger = Float[Tensor, "H W 3"]
Enlarge = Callable[[Renderer, Image, Camera], Larger]  # (the scene's own renderer, source image, target camera)


def source_of(
    views: Sequence[Camera],
    name: Literal["auto", "photographs", "self"] = "auto",
    protocol: Protocol = PROTOCOLS["default"],
) -> TruthSource:
    """The source of this name; for "auto", photographs if every view has one, else the scene's own render ("self").

    Raises UsageError if the source is photographs, and a view has none or the protocol moves the camera.
    """
    missing = [view.name for view in views if view.photo is None]
    if name == "self" or (name == "auto" and missing):
        return "self"
    if protocol.change != "size":
        raise UsageError("truth", f"protocol {protocol.name} moves the camera: no photograph shows that")
    if missing:
        raise UsageError(missing[0], NO_PHOTOGRAPH)
    return "photographs"


def upsampled(upsampler: Upsampler) -> Enlarge:
    """Estimate ground truth by enlarging the source image with an upsampler."""
    return lambda renderer, full, camera: upsampler(full, camera.hw)


def back_projected(renderer: Renderer, full: Image, camera: Camera) -> Larger:
    """The scene's own render after one step of iterative back-projection towards the source image.

    (Irani and Peleg 1991.)  The bicubically enlarged residual is added, so box averages match only approximately.
    """
    with torch.no_grad():
        image = renderer(camera).rgb.clamp(0.0, 1.0)
    averages = resampled(image, full.shape[1] / camera.width, (full.shape[0], full.shape[1]))
    return image + bicubic(full - averages, camera.hw)


@dataclass(frozen=True, eq=False)
class Truth:
    """The images to compare with.

    renderer: renders the scene by training's rule (see `rendering.renderer.own_look`), or the reference by its recipe.
    enlarge: estimates ground truth above the source's size, if given.
    memory: bytes of 16-bit images to cache between calls; None caches none.
    """

    renderer: Renderer
    source: TruthSource = "self"
    protocol: Protocol = PROTOCOLS["default"]
    enlarge: Enlarge | None = None
    memory: float | None = None
    cache: dict[tuple[object, ...], Tensor] = field(default_factory=dict, init=False, repr=False)
    slab: list[Tensor] = field(default_factory=list, init=False, repr=False)  # of the cache: the last one's unused end

    def __call__(self, view: Camera, scale: float) -> Image:
        """Ground truth of `view` (given at the training size) at `scale`; it must be defined there."""
        image = ViewTruth(self, view).image(scale)
        assert image is not None
        return image

    @cached_property
    def timed(self) -> TimedRenderer:
        """The renderer with a clock; one for all views."""
        return TimedRenderer(self.renderer)

    def supersampled(self, scale: float) -> Renderer:
        """The renderer of a view that a protocol moves, with samples as dense as training's pixels."""
        samples = max(1, math.ceil(1 / scale))
        return replace(self.renderer, recipe=replace(self.renderer.recipe, grid=samples))


class ViewTruth:
    """Ground truth of one view; its photograph and its training-size render are each made at most once, on demand."""

    def __init__(self, truth: Truth, view: Camera):
        self.truth, self.view = truth, view
        self.reference = cache(lambda scale: truth.timed(self.camera(scale)))  # the reference at a scale
        self.motion = cache(self._motion)

    def camera(self, scale: float) -> Camera:
        """The view at a scale."""
        return self.truth.protocol.camera(self.view, scale, self._depth)

    def compared(self, scale: float) -> Image | None:
        """The image that renders are compared with, None if undefined; the scene's own are rounded to 8 bits."""
        image = self.image(scale)
        return image if image is None or self.truth.source == "photographs" else quantised(image)

    def image(self, scale: float) -> Image | None:
        """The truth at a scale, before rounding; None where there is none.  It is cached while there is room."""
        truth, view = self.truth, self.view
        if truth.memory is None:
            return self._image(scale)
        pose = view.cam_from_world.detach().cpu().numpy().tobytes()
        key = scale, *(vars(view) | {"cam_from_world": pose, "name": None}).values()  # names recur in other splits
        image = truth.cache.get(key)
        if image is None:
            new = self._image(scale)
            if new is None:
                return None
            image = levels(new, CACHE_BITS).to(CACHE_DTYPE)
            if sum(cached.nbytes for cached in truth.cache.values()) + image.nbytes <= truth.memory:
                # in a slab: small blocks that stay, between large ones that go, would keep those from the system
                size = image.numel()
                if not truth.slab or len(truth.slab[0]) < size:
                    truth.slab[:] = [torch.empty(max(size, SLAB_SIZE), dtype=CACHE_DTYPE)]
                place, truth.slab[0] = truth.slab[0].split([size, len(truth.slab[0]) - size])
                truth.cache[key] = place.view(image.shape).copy_(image)
        return image.float() / (2**CACHE_BITS - 1)

    def _image(self, scale: float) -> Image | None:
        truth, camera = self.truth, self.camera(scale)
        if truth.source == "reference":
            return self.reference(scale).rgb
        if truth.protocol.change != "size":
            return TimedRenderer(truth.supersampled(scale))(camera).rgb
        photographs = truth.source == "photographs"
        if photographs:
            factors = self._photograph.factors(self.view, scale)
            if factors[1] <= 1 + 1 / min(self._photograph.hw[1], self.view.width):  # either was rounded
                return self._photograph.at(camera.hw, factors)
        elif truth.renderer.training.relative_rate(camera) <= 1:
            return self.resized_look(scale)
        if truth.enlarge is not None:
            full = self._photograph.at(self._photograph.hw, (1.0, 1.0)) if photographs else self.look.rgb.clamp(0, 1)
            return truth.enlarge(truth.renderer, full, camera).clamp(0.0, 1.0)
        if photographs:
            return None
        return TimedRenderer(replace(truth.renderer, recipe=find_recipe("auto", quality="best")))(camera).rgb

    @cached_property
    def look(self) -> TimedImage:
        """The scene's own render at the training size."""
        return self.truth.timed(self.view)

    def resized_look(self, scale: float) -> Image:
        """The training-size render resampled to this scale: downsampled below 1, bicubic above."""
        return self.truth.protocol.resized(self.look.rgb.clamp(0, 1), self.camera(scale), scale)

    def _motion(self, scale: float) -> list[Image]:
        """Frames that move by 1/4 px of this scale: of the reference, or of training-size renders, then resampled."""
        camera, timed = self.camera(scale), self.truth.timed
        if self.truth.source == "reference":
            return timed.motion(camera, self.reference(scale))
        frames = timed.motion(self.view, self.look, scale)
        return [self.truth.protocol.resized(frame, camera, scale) for frame in frames]

    @cached_property
    def _photograph(self) -> Photograph:
        assert self.view.photo is not None
        downscale = DOWNSCALES[self.truth.protocol.downscale]
        return downscale.read(self.view.photo, self.truth.renderer.background, self.view.undistortion)

    @cached_property
    def _depth(self) -> float:
        """Median depth of the scene in the view, in world units; needed only where the distance changes."""
        if self.truth.protocol.change != "distance":
            return 1.0
        return median_depth(self.truth.renderer.scene.means, self.view)
