"""Figures: metrics that compare a candidate with itself, so that they need no truth."""

import math
from collections.abc import Sequence
from itertools import pairwise

import cv2
from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.metric import Metric
from aaplug.evaluation.series import Series
from aaplug.evaluation.similarity import psnr

LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709, on the values as stored


def energy(rgb: Float[Tensor, "h w 3"]) -> float:
    """Mean luminance (Rec. 709)."""
    means = cv2.mean(rgb.cpu().numpy())  # summed in float64
    return sum(weight * mean for weight, mean in zip(LUMINANCE, means, strict=False))


def energy_drift(drawn: Float[Tensor, "h w 3"], expected: Float[Tensor, "H W 3"]) -> float | None:
    """Relative excess of an image's light over the expected light; None where none is expected."""
    before = energy(expected)
    return None if before == 0 else energy(drawn) / before - 1


def flicker(frames: Sequence[Float[Tensor, "h w 3"]], motion: Sequence[Float[Tensor, "h w 3"]]) -> float | None:
    """RMS change from frame to frame, over that of `motion` alone; None where nothing moves.

    Above 1 the image shimmers, below 1 it is blurred.
    """
    own, expected = (sum(float((b - a).double().square().mean()) for a, b in pairwise(x)) for x in (frames, motion))
    return None if expected == 0 else math.sqrt(own / expected)


def _consistency(series: Series) -> float | None:
    if series.full is None or series.scale >= 1:
        return None
    return psnr(series.drawn.rgb.clamp(0, 1), series.smaller(series.full.rgb.clamp(0, 1)))


def _energy_drift(series: Series) -> float | None:
    if series.full is None:
        return None
    rows, columns = (math.ceil(side / series.scale) for side in series.drawn.rgb.shape[:2])
    return energy_drift(series.drawn.light, series.full.light[:rows, :columns])


def _flicker(series: Series) -> float | None:
    if series.frames is None or series.scale >= 1:
        return None
    return flicker(*series.frames())


CONSISTENCY = Metric(
    "consistency",
    "dB",
    math.inf,
    2,
    "PSNR of the image against the recipe's own training-size image, box-averaged; null at and above that size, where "
    "the two are equal, and where scale 1 is not measured",
    figure=_consistency,
)
ENERGY = Metric(
    "energy drift",
    "",
    0.0,
    4,
    "luminance of what is drawn, without the background, over the recipe's own at the training size, minus 1; "
    "null where scale 1 is not measured",
    figure=_energy_drift,
)
FLICKER = Metric(
    "flicker",
    "",
    1.0,
    3,
    "frame-to-frame change over three steps of 1/4 px, over that of the training-size image, averaged down: 1 is "
    "motion alone; null at and above the training size",
    figure=_flicker,
)
