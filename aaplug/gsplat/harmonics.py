"""gsplat's `spherical_harmonics`, for programs that compute colours themselves."""

from typing import Annotated

from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.spherical_harmonics import COLOUR_OFFSET, sh_colour
from aaplug.system.contracts import Range, contract
from aaplug.system.errors import UsageError


@contract
def spherical_harmonics(
    degrees_to_use: Annotated[int, Range(0, 4)],
    dirs: Float[Tensor, "*b 3"],
    coeffs: Float[Tensor, "*b k 3"],
    masks: Bool[Tensor, "*b"] | None = None,
) -> Float[Tensor, "*b 3"]:
    """Sums of real spherical harmonics, [*b, 3], without 3DGS's offset of 0.5.

    b: leading dimensions; k: coefficients per channel, of which the first (degree + 1)² are read.

    dirs: of any length but zero.  masks: where False, the sum is 0.

    Raises UsageError if shapes do not fit each other, or there are too few coefficients.
    """
    count, given = (degrees_to_use + 1) ** 2, coeffs.shape[-2]
    if count > given:
        raise UsageError("degrees_to_use", f"{degrees_to_use} needs {count} coefficients, coeffs has {given}")
    directions = functional.normalize(dirs.reshape(-1, 3), dim=1)
    sums = (sh_colour(coeffs[..., :count, :].reshape(-1, count, 3), directions) - COLOUR_OFFSET).view_as(dirs)
    return sums if masks is None else sums.where(masks[..., None], 0.0)
