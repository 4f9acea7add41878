"""A metric: mean absolute error."""

from jaxtyping import Float
from torch import Tensor

from aaplug.evaluation.metric import Metric


def mean_absolute_error(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> float | None:
    """Mean over pixels and channels; undefined for an empty image."""
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
