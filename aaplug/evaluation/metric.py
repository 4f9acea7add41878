"""Metric: a named number about an image.

Images are [h, w, 3] in [0, 1].
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.series import Series

SsimFlavour = Literal["wang", "3dgs"]
LpipsFlavour = Literal["3dgs", "vgg", "alex"]
Image = Float[Tensor, "h w 3"]


@dataclass(frozen=True)
class MetricOptions:
    """What a user chooses about metrics.  lpips_weights: files of the trunk and of the heads."""

    ssim: SsimFlavour = "wang"
    lpips: LpipsFlavour = "vgg"
    lpips_weights: tuple[Path, Path] | None = None


@dataclass(frozen=True)
class Metric:
    """A named number about an image; exactly one of `measure` and `figure` is given.

    unit: "" for none.
    ideal: value of a perfect image; infinite where higher is always better.
    digits: decimals in tables.
    protocol: which of the field's variants it is, in words.
    measure: the value for an image and the truth, both of 8 bits; None where it is undefined.
    figure: the value for images of one candidate, without a truth; None where it is undefined.
    undefined: why a value can be None, in words; reports print it as a note.
    prepare: makes the metric that the user's options ask for; None if no option concerns it.
    """

    name: str
    unit: str
    ideal: float
    digits: int
    protocol: str
    measure: Callable[[Image, Image], float | None] | None = None
    figure: Callable[[Series], float | None] | None = None
    undefined: str = "undefined for this image"
    prepare: Callable[[MetricOptions], "Metric"] | None = None

    def prepared(self, options: MetricOptions) -> "Metric":
        """The metric as the options ask for it; raises UsageError or FormatError where it lacks what it needs."""
        return self if self.prepare is None else self.prepare(options)

    def compare(self, image: Image, truth: Image) -> float | None:
        """The value of `measure`; None where that is undefined, NaN or infinite."""
        assert self.measure is not None
        return _finite(self.measure(image, truth))

    def of(self, series: Series) -> float | None:
        """The value of `figure`; None where that is undefined, NaN or infinite."""
        assert self.figure is not None
        return _finite(self.figure(series))

    @property
    def title(self) -> str:
        """Name and unit."""
        return self.name + (f" [{self.unit}]" if self.unit else "")

    def text(self, value: float | None) -> str:
        """A value as tables show it."""
        return "–" if value is None else f"{value:.{self.digits}f}"

    def loss(self, value: float) -> float:
        """Lower is better."""
        return -value if math.isinf(self.ideal) else abs(value - self.ideal)


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None
