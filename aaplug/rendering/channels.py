"""Channels of splats beside their colours, composited as colours are.

m: splats; d: channels; h, w: px.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.splats import Render, Splats2D


def composited(
    splats: Splats2D, channels: Float[Tensor, "m d"], draw: Callable[[Splats2D], Render], per_call: Sequence[int]
) -> Render:
    """Premultiplied channels, and alpha.

    draw: composites coloured splats over black.  per_call: the numbers of channels of which one is drawn at a time.
    """
    width = channels.shape[1]
    at_once = min(per_call, key=lambda count: -(-width // count))
    parts = functional.pad(channels, (0, -width % at_once)).split(at_once, dim=1)
    images = [draw(replace(splats, rgb=part)) for part in parts]
    planes = [image.rgb.movedim(2, 0) for image in images]  # as they lie in memory
    planes[-1] = planes[-1][: width - at_once * (len(planes) - 1)]
    return Render(torch.cat(planes).movedim(0, 2), images[0].alpha)
