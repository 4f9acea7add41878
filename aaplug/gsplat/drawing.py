"""Images of any number of channels, drawn three at a time, and the absolute gradients of splats' centres.

m: splats of one image; d: channels, of which the first are colours; h, w: px.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.cameras import BLACK
from aaplug.core.interfaces import PixelKernel, Rasterizer
from aaplug.core.splats import Splats2D
from aaplug.gsplat.arguments import Options
from aaplug.methods.pixel_kernels import POINT
from aaplug.methods.pixel_kernels.absolute import ABSOLUTE_POINT

AT_ONCE = 3  # channels, what a rasterizer draws
LEAST_ALPHA = 1e-10  # what expected depth is divided by where nothing is drawn

Image = tuple[Float[Tensor, "h w d"], Float[Tensor, "h w 1"]]
Told = Callable[[Float[Tensor, "m 2"]], object]


def drawn(
    splats: Splats2D,
    features: Float[Tensor, "m d"],
    background: Float[Tensor, " colours"] | None,
    options: Options,
    rasterizer: Rasterizer,
    tell: Told | None,
) -> Image:
    """Features and alpha; depth, the last channel, has no background and may be divided by alpha.

    tell: called in the backward pass with the absolute gradients of the centres, if they are wanted.
    """
    width = features.shape[1]
    padded = functional.pad(features, (0, -width % AT_ONCE))
    parts = [_three(replace(splats, rgb=rgb), options, rasterizer, tell) for rgb in padded.split(AT_ONCE, dim=1)]
    alpha = parts[0][..., AT_ONCE:]
    image = torch.cat([part[..., :AT_ONCE] for part in parts], dim=2)[..., :width]
    if background is not None and options.coloured:
        behind = functional.pad(background, (0, width - len(background)))
        image = image + (1 - alpha) * behind
    if options.render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp(min=LEAST_ALPHA)], dim=2)
    return image, alpha


def _three(splats: Splats2D, options: Options, rasterizer: Rasterizer, tell: Told | None) -> Float[Tensor, "h w 4"]:
    """Three premultiplied channels, and alpha."""
    rules = options.convention.rules

    def paint(splats: Splats2D, kernel: PixelKernel) -> Tensor:
        image = rasterizer(splats, options.hw, BLACK, kernel, None, rules)
        return torch.cat([image.rgb, image.alpha[..., None]], dim=2)

    image = paint(splats, POINT)

    def backward(gradient: Tensor) -> None:
        assert tell is not None
        with torch.enable_grad():
            constants = {name: x.detach() for name, x in vars(splats).items() if isinstance(x, Tensor)}
            means = constants["means"].requires_grad_()
            again = paint(replace(splats, **constants), ABSOLUTE_POINT)
        tell(torch.autograd.grad(again, means, gradient)[0])

    if tell is not None and image.requires_grad:
        image.register_hook(backward)
    return image
