"""Metric: a named number about an image.

Images are [h, w, 3] in [0, 1].
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.protocols import Protocol
from aaplug.evaluation.series import Series

Image = Float[Tensor, "h w 3"]
LpipsFiles = tuple[Path, Path]  # of the trunk and of the heads


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
    prepare: makes the metric as a protocol asks for it, with LPIPS's files; None if neither concerns it.
    """

    name: str
    unit: str
    ideal: float
    digits: int
    protocol: str
    measure: Callable[[Image, Image], float | None] | None = None
    figure: Callable[[Series], float | None] | None = None
    undefined: str = "undefined for this image"
    prepare: Callable[[Protocol, LpipsFiles | None], "Metric"] | None = None

    def compare(self, image: Image, truth: Image) -> float | None:
        """The value of `measure`; None where that is undefined, NaN or infinite."""
        return _finite(self.measure(image, truth)) if self.measure else None

    def of(self, series: Series) -> float | None:
        """The value of `figure`; None where that is undefined, NaN or infinite."""
        return _finite(self.figure(series)) if self.figure else None

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
