"""Real spherical harmonics of degree 0 to 4, in the order and with the signs of 3DGS.

m: directions; k: coefficients per channel, (degree + 1)².
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

MOST_COEFFICIENTS = 25  # per channel, of degree 4
COLOUR_OFFSET = 0.5  # 3DGS stores colours around mid-grey
ROUNDING = 1e-12  # of a rotation of harmonics: a smaller entry is 0

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
SH_C4 = (  # 3/4·√(35/π), 3/4·√(35/2π), 3/4·√(5/π), 3/4·√(5/2π), 3/16·√(1/π)
    2.5033429417967046,
    1.7701307697799304,
    0.9461746957575601,
    0.6690465435572892,
    0.10578554691520431,
)


def sh_colour(sh: Float[Tensor, "m k 3"], directions: Float[Tensor, "m 3"]) -> Float[Tensor, "m 3"]:
    """Colour of real spherical harmonics of degree 0 to 4 in unit directions from the camera, not clamped."""
    colour = torch.full_like(directions, COLOUR_OFFSET)
    for basis, coefficients in zip(_sh_basis(directions, sh.shape[1]), sh.unbind(dim=1), strict=True):
        colour = colour + basis[:, None] * coefficients
    return colour


def sh_turned(sh: Float[Tensor, "n k 3"], turn: Float[Tensor, "3 3"]) -> Float[Tensor, "n k 3"]:
    """The harmonics of a scene that is turned: their colour along turn · d is what it was along d.

    A rotation takes each degree to itself, so 2·25 directions determine the matrix (Green 2003, "Spherical Harmonic
    Lighting"); it is solved in float64.
    """
    k = sh.shape[1]
    ways = even_directions(2 * MOST_COEFFICIENTS)
    after, before = (torch.stack(_sh_basis(d, k), dim=1) for d in (ways, ways @ turn.double()))
    matrix = torch.linalg.lstsq(after, before).solution
    matrix = torch.where(matrix.abs() > ROUNDING, matrix, 0.0)
    return torch.einsum("jk,nkc->njc", matrix, sh.double()).to(sh.dtype)


def even_directions(count: int) -> Float[Tensor, "count 3"]:
    """Unit vectors spread evenly over the sphere, on a Fibonacci spiral, in float64."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    z, angle = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    level = (1 - z * z).sqrt()
    return torch.stack([level * angle.cos(), level * angle.sin(), z], dim=1)


def _sh_basis(directions: Float[Tensor, "m 3"], coefficients: int) -> list[Float[Tensor, " m"]]:
    x, y, z = directions.unbind(dim=1)
    xx, yy, zz = x * x, y * y, z * z
    basis = [torch.full_like(x, SH_C0)]
    if coefficients > 1:
        basis += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if coefficients > 4:
        basis += [SH_C2[0] * x * y, -SH_C2[0] * y * z, SH_C2[1] * (2 * zz - xx - yy)]
        basis += [-SH_C2[0] * x * z, SH_C2[2] * (xx - yy)]
    if coefficients > 9:
        basis += [-SH_C3[0] * y * (3 * xx - yy), SH_C3[1] * x * y * z, -SH_C3[2] * y * (4 * zz - xx - yy)]
        basis += [SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy), -SH_C3[2] * x * (4 * zz - xx - yy)]
        basis += [SH_C3[4] * z * (xx - yy), -SH_C3[0] * x * (xx - 3 * yy)]
    if coefficients > 16:
        basis += [SH_C4[0] * x * y * (xx - yy), -SH_C4[1] * y * z * (3 * xx - yy)]
        basis += [SH_C4[2] * x * y * (7 * zz - 1), -SH_C4[3] * y * z * (7 * zz - 3)]
        basis += [SH_C4[4] * (zz * (35 * zz - 30) + 3), -SH_C4[3] * x * z * (7 * zz - 3)]
        basis += [SH_C4[2] / 2 * (xx - yy) * (7 * zz - 1), -SH_C4[1] * x * z * (xx - 3 * yy)]
        basis += [SH_C4[0] / 4 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))]
    return basis
