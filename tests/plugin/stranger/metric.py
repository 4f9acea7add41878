"""A metric: mean absolute error."""

from torch import Tensor

from aaplug import Metric


def mean_absolute_error(image: Tensor, truth: Tensor) -> float | None:
    """Mean over pixels and channels of images [h, w, 3] in [0, 1]; undefined for an empty image."""
    return None if image.numel() == 0 else float((image - truth).abs().mean())


MAE = Metric(
    "MAE",
    unit="",
    ideal=0.0,
    digits=4,
    protocol="mean absolute error over pixels and channels, range 0 to 1",
    measure=mean_absolute_error,
    undefined="the image is empty",
)
