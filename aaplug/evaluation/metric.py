"""Metric: a named number about an image; and the timed images of one renderer that it can look at.

Images are [h, w, 3] in [0, 1].
"""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.colours import Colour
from aaplug.core.interfaces import CountsEvaluations
from aaplug.rendering.renderer import Renderer
from aaplug.system.contracts import Range, check_fields
from aaplug.system.errors import PlugInError, UsageError
from aaplug.system.plug_ins import asked

Image = Float[Tensor, "h w 3"]
SHIFT_STEPS = 4  # frames of a motion; between two of them the image moves 1/4 px right and down


@dataclass(frozen=True, eq=False)
class TimedImage:
    """A timed render.

    samples: along a pixel's side.  seconds: wall clock.  evaluations: of a splat at a pixel; None if not counted.
    """

    rgb: Image
    alpha: Float[Tensor, "h w"]
    background: Colour
    samples: int
    seconds: float
    evaluations: int | None

    @property
    def light(self) -> Image:
        """The colours without the background."""
        return self.rgb - (1 - self.alpha[..., None]) * self.rgb.new_tensor(self.background)


class TimedRenderer:
    """A renderer that times its images and counts their splat-pixel evaluations where rasterizer and kernels can."""

    def __init__(self, renderer: Renderer):
        self._evaluations: list[int] | None = None
        if isinstance(renderer.rasterizer, CountsEvaluations):
            self._evaluations = []
            renderer = replace(renderer, rasterizer=renderer.rasterizer.counting(self._evaluations.append))
        self.renderer = renderer

    def __call__(self, camera: Camera) -> TimedImage:
        """Render one view, without gradients."""
        if self._evaluations is not None:
            self._evaluations.clear()
        renderer = self.renderer.at(camera.frame)
        started = time.perf_counter()
        with torch.no_grad():
            rgb, alpha = renderer(camera)
        seconds = time.perf_counter() - started
        without_kernels = renderer.recipe.compositor is not None and not self._evaluations
        evaluations = None if self._evaluations is None or without_kernels else sum(self._evaluations)
        samples, background = renderer.samples(camera), renderer.background
        return TimedImage(rgb.float(), alpha.float(), background, samples, seconds, evaluations)

    def motion(self, camera: Camera, first: TimedImage, scale: float = 1.0) -> list[Image]:
        """Frames, clamped to [0, 1], whose content moves by 1/4 px of the image that is `scale` times as large.

        Of a scene in time they are the next frames instead, up to its last.

        first: the render of `camera` itself.
        """
        steps = [step / scale / SHIFT_STEPS for step in range(1, SHIFT_STEPS)]
        views = [replace(camera, cx=camera.cx + step, cy=camera.cy + step) for step in steps]
        if (frames := self.renderer.in_time) is not None:
            views = [replace(camera, frame=k) for k in range(len(frames))[camera.frame + 1 :][: len(views)]]
        return [image.rgb.clamp(0, 1) for image in (first, *map(self, views))]


@dataclass(frozen=True, eq=False)
class Series:
    """Images of one renderer in one view at one scale.

    image: at that scale.
    full: by the same renderer at the training size; None if scale 1 is not measured or a scale moves the camera.
    smaller: averages a training-size image down to that scale.
    frames: draws the renderer's frames of a small motion, and those of the truth: of the scene's own look, averaged
        down, or of the reference; None if a scale moves the camera.
    """

    scale: float
    image: TimedImage
    full: TimedImage | None
    smaller: Callable[[Float[Tensor, "H W 3"]], Image]
    frames: Callable[[], tuple[Sequence[Image], Sequence[Image]]] | None


@dataclass(frozen=True)
class Metric:
    """A named number about an image; exactly one of `measure` and `figure` is given.

    unit: "" for none.
    ideal: value of a perfect image; infinite where higher is always better.
    digits: decimals in tables.
    protocol: the field's variant that it is, in words.
    measure: the value for an image of 8 bits and the truth; None where it is undefined.
    figure: the value for images of one renderer, without a truth; None where it is undefined.
    undefined: the reason why a value can be None; reports print it as a note.
    smaller: `figure` is defined below the training size alone.
    """

    name: str
    unit: str
    ideal: float
    digits: Annotated[int, Range(0)]
    protocol: str
    measure: Callable[[Image, Image], float | None] | None = None
    figure: Callable[[Series], float | None] | None = None
    undefined: str = "undefined for this image"
    smaller: bool = False

    def __post_init__(self) -> None:
        check_fields(self)
        if (self.measure is None) == (self.figure is None):
            raise UsageError(f"metric {self.name}", "needs either `measure` or `figure`")

    def compare(self, image: Image, truth: Image) -> float | None:
        """The value of `measure`; None where that is undefined, NaN or infinite."""
        return self._number(asked("metric", self, "measure", image.detach(), truth.detach())) if self.measure else None

    def of(self, series: Series) -> float | None:
        """The value of `figure`; None where that is undefined, NaN or infinite."""
        none = self.figure is None or (self.smaller and series.scale >= 1)
        return None if none else self._number(asked("metric", self, "figure", series))

    def _number(self, value: Any) -> float | None:
        try:
            if isinstance(value, str):
                raise TypeError("text")
            number = None if value is None else float(value.detach() if isinstance(value, Tensor) else value)
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise PlugInError(f"metric {self.name}", f"gives no number but {type(value).__name__}: {error}") from error
        return number if number is not None and math.isfinite(number) else None

    @property
    def title(self) -> str:
        """Name and unit."""
        return self.name + (f" [{self.unit}]" if self.unit else "")

    def text(self, value: float | None) -> str:
        """A value as tables show it."""
        return number(value, self.digits)

    def loss(self, value: float) -> float:
        """Lower is better."""
        return -value if math.isinf(self.ideal) else abs(value - self.ideal)


def number(value: float | None, digits: int) -> str:
    """A value as tables show it."""
    return "–" if value is None else "∞" if value == math.inf else f"{value:.{digits}f}"
