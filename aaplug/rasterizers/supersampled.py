"""Several samples a pixel: draw the image n times as large and average boxes of n × n samples."""

from jaxtyping import Float
from torch import Tensor

from aaplug.splats import Render


def averaged(render: Render, n: int) -> Render:
    """Average n×n samples a pixel; sides must be multiples of n."""
    return (
        Render(_boxes(render.rgb, n), _boxes(render.alpha[..., None], n)[..., 0])
        if n > 1
        else render
    )


def _boxes(image: Float[Tensor, "h w c"], n: int) -> Float[Tensor, "H W c"]:
    return image.unflatten(1, (-1, n)).unflatten(0, (-1, n)).mean(dim=(1, 3))
