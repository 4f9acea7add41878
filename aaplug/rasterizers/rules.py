"""The rules of 3DGS's compositing that every rasterizer keeps (Kerbl et al. 2023, and its published constants)."""

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.splats import Render

# Rounded to float32 as 3DGS has them, in every precision: (1 − 0.99)² is a hair under 1e-4 there, and two splats at the
# cap, which are common, end a pixel.
MAX_ALPHA = torch.tensor(0.99).item()  # no splat hides more than this
MIN_TRANSMITTANCE = torch.tensor(
    1e-4
).item()  # a pixel stops before the splat that would bring it under this


def just_below(value: float) -> float:
    """The float32 before a positive value: `threshold` keeps what is above its bound, and so the value itself too."""
    return torch.nextafter(torch.tensor(value), torch.tensor(0.0)).item()


def over(
    rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"], background: tuple[float, float, float]
) -> Render:
    """Put an image of premultiplied colours over a background."""
    if not any(background):  # black adds nothing
        return Render(rgb, alpha)
    return Render(torch.addcmul(rgb, (1 - alpha)[..., None], rgb.new_tensor(background)), alpha)
