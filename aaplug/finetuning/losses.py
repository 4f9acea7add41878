"""The loss that a fine-tuning step minimises; others come as plug-ins.

A loss says how far an image is from its truth: 0 for equal images, and differentiable in the first.
"""

from jaxtyping import Float
from torch import Tensor


def l2(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, ""]:
    """Mean squared error (Mipmap-GS)."""
    return (image - truth).square().mean()
