"""Images as arrays: compositing over a background, resampling, and rounding to stored bits.

Images are [h, w, 3] in [0, 1].  A factor is the density of the new pixels against the old ones.
"""

import math
from functools import reduce

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.cameras import WHOLE_SLACK, whole_side
from aaplug.core.splats import Render
from aaplug.system.contracts import contract
from aaplug.system.errors import UsageError

Factors = tuple[float, float]  # of rows and of columns
SRGB_KNEE = 0.04045  # up to which sRGB is proportional to light


@contract
def over(
    rgb: Float[Tensor, "h w d"],
    alpha: Float[Tensor, "h w"],
    background: tuple[float, float, float] | Float[Tensor, " c"],
) -> Render:
    """Composite premultiplied colours over a background; further channels have none."""
    if not isinstance(background, Tensor):
        if not any(background):  # black adds nothing
            return Render(rgb, alpha)
        background = rgb.new_tensor(background)
    behind = functional.pad(background, (0, rgb.shape[2] - len(background)))
    planes = rgb.permute(2, 0, 1)  # as the rasterizer lays them out
    # The gradient of an outer product is a matrix times a vector, faster than products and their sum.
    over_it = torch.addr(planes.flatten(1), behind, (1 - alpha).flatten()).view(planes.shape)
    return Render(over_it.permute(1, 2, 0), alpha)


def linear(rgb: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    """Values proportional to light, of those that a display takes (sRGB, IEC 61966-2-1), also above 1."""
    return torch.where(rgb <= SRGB_KNEE, rgb / 12.92, ((rgb.clamp(min=SRGB_KNEE) + 0.055) / 1.055) ** 2.4)


def straight(rgb: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w"]) -> Float[Tensor, "h w 3"]:
    """Premultiplied colours divided by alpha; 0 where it is."""
    return torch.where(alpha[..., None] > 0, rgb / alpha[..., None], 0.0)


def average_samples(render: Render, n: int, neighbours: float = 0.0) -> Render:
    """Average n x n samples per pixel; both sides must be multiples of n.

    neighbours: weight w with which each sample first takes in those on either side, (w, 1 - 2w, w) along each axis;
    edges repeat.  It keeps the sum of the samples, and samples that are all equal.
    """
    if n == 1 and neighbours == 0:
        return render
    rgb, alpha = (_pooled(image, n, neighbours) for image in (render.rgb, render.alpha[..., None]))
    return Render(rgb, alpha[..., 0])


def box_average(image: Float[Tensor, "h w c"], n: int) -> Float[Tensor, "H W c"]:
    """Mean of each box of n x n px; a partial box at the bottom or the right is cropped."""
    rows, columns = (side // n for side in image.shape[:2])
    return _pooled(image[: rows * n, : columns * n], n)


def resampled(
    rgb: Float[Tensor, "h w 3"], factor: float | Factors, hw: tuple[int, int] | None = None
) -> Float[Tensor, "h2 w2 3"]:
    """Resample by `factor`, of both axes or of rows and columns: box averages below 1, bicubic above.

    Boxes are exact where 1/factor is whole, else area-weighted.  A partial pixel at the bottom or the right is
    cropped; `hw` asks for that height and width.

    Raises:
        UsageError: no box fits into the image.
    """
    height, width, _ = rgb.shape
    rows, columns = factor if isinstance(factor, tuple) else (factor, factor)
    hw = hw or (whole_side(height * rows), whole_side(width * columns))
    if rows == columns == 1:
        return rgb[: hw[0], : hw[1]]
    box = round(1 / columns)
    if columns < 1 and max(abs(1 / each - box) for each in (rows, columns)) < WHOLE_SLACK:
        if box > min(height, width):
            raise UsageError("scale", f"{columns:g} leaves no pixel of a {width}x{height} image")
        return box_average(rgb, box)[: hw[0], : hw[1]]
    if columns < 1:
        return _averaged(_averaged(rgb, rows, hw[0]), columns, hw[1])
    factors = rows * (1 + WHOLE_SLACK / height), columns * (1 + WHOLE_SLACK / width)  # a side is cut to whole pixels
    planes = functional.interpolate(rgb.permute(2, 0, 1)[None], scale_factor=factors, mode="bicubic")[0]
    return planes.permute(1, 2, 0)[: hw[0], : hw[1]].contiguous()


def stretched(rgb: Float[Tensor, "h w 3"], hw: tuple[int, int]) -> Float[Tensor, "h2 w2 3"]:
    """Resize the whole image to `hw`: area-weighted averages to fewer columns, bicubic to more."""
    return resampled(rgb, (hw[0] / rgb.shape[0], hw[1] / rgb.shape[1]), hw)


def quantised(rgb: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """The colours of a PNG of 8 bits of this image that is read back."""
    return levels(rgb, 8) / 255


def levels(rgb: Float[Tensor, "h w c"], bit_depth: int) -> Float[Tensor, "h w c"]:
    """Clamp to [0, 1] and round to whole levels, 0 to 2^bit_depth - 1."""
    assert bool(torch.isfinite(rgb).all()), "a rendered colour is NaN or infinite"
    return (rgb.clamp(0, 1) * (2**bit_depth - 1)).round()


def _pooled(image: Float[Tensor, "h w c"], n: int, neighbours: float = 0.0) -> Float[Tensor, "H W c"]:
    """Means of boxes: see `average_samples`.  Exchanges inside a box leave its sum; only those at its border count."""
    for dim in (0, 1):
        along = image.movedim(dim, 0)
        boxes = reduce(torch.add, (along[i::n] for i in range(n)))
        if neighbours:
            steps = neighbours * (along[n::n] - along[n - 1 : -1 : n])
            boxes = boxes.clone()
            boxes[:-1] += steps
            boxes[1:] -= steps
        image = boxes.movedim(0, dim)
    return image / n**2


def _averaged(image: Float[Tensor, "h w c"], factor: float, count: int) -> Float[Tensor, "w n c"]:
    """The first `count` means over 1/factor rows, which need not be whole; as columns."""
    edges = torch.arange(count + 1, dtype=torch.float64, device=image.device)[:, None] / factor
    start, end = edges[:-1], edges[1:]
    rows = start.floor() + torch.arange(math.ceil(1 / factor) + 1, device=image.device)
    shares = factor * (torch.minimum(end, rows + 1) - torch.maximum(start, rows)).clamp(min=0)
    rows = rows.long().clamp(max=len(image) - 1)
    means = functional.embedding_bag(rows, image.flatten(1), per_sample_weights=shares.to(image), mode="sum")
    return means.view(count, *image.shape[1:]).transpose(0, 1).contiguous()
