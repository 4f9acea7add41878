"""The rules of 3DGS's compositing that every rasterizer keeps (Kerbl et al. 2023, and its published constants)."""

from jaxtyping import Float
from torch import Tensor

from aaplug.splats import Render

MAX_ALPHA = 0.99  # no splat hides more than this
MIN_TRANSMITTANCE = 1e-4  # a pixel stops before the splat that would bring it under this


def over(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], background: tuple[float, float, float]
) -> Render:
    """Put an image of premultiplied colours over a background."""
    return Render(rgb + (1 - alpha)[..., None] * rgb.new_tensor(background), alpha)
