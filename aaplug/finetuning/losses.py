"""The loss that a fine-tuning step minimises; others come as plug-ins."""

from typing import Protocol, runtime_checkable

from jaxtyping import Float
from torch import Tensor


@runtime_checkable
class Loss(Protocol):
    """How far an image is from what it should show: 0 for equal images, and differentiable in the first."""

    def __call__(self, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]: ...  # noqa: D102


def l2(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean squared error (Mipmap-GS)."""
    return (image - truth).square().mean()
