"""A scene in other axes: mirrored, turned, scaled and moved, its harmonics with it.

n: Gaussians.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.gaussians import Gaussians
from aaplug.core.projection import quats_of
from aaplug.core.spherical_harmonics import sh_turned


def mirrored(scene: Gaussians, signs: Sequence[float]) -> Gaussians:
    """The scene with its x, y and z times these signs; two of -1 are a half turn about the third axis.

    A harmonic of degree l and order m is multiplied by (−1)^(|m| + (m < 0)) for x, by (−1)^(m < 0) for y and by
    (−1)^(l − |m|) for z.  It is exact: the same signs again give the same bits.
    """
    x, y, z = signs
    orders = [(d, m) for d in range(scene.sh_degree + 1) for m in range(-d, d + 1)]
    factors = [x ** (abs(m) + (m < 0)) * y ** (m < 0) * z ** (d - abs(m)) for d, m in orders]
    return replace(
        scene,
        means=scene.means * scene.means.new_tensor(signs),
        quats=scene.quats * scene.quats.new_tensor([1.0, y * z, x * z, x * y]),
        sh=scene.sh * scene.sh.new_tensor(factors)[:, None],
    )


def placed(scene: Gaussians, turn: Float[Tensor, "3 3"], scale: float, move: Sequence[float]) -> Gaussians:
    """The scene with every point x at scale · turn · x + move.

    turn: a rotation matrix.  scale: above 0.  move: world units.
    """
    dtype, turn = scene.means.dtype, turn.double()
    w, x, y, z = quats_of(turn[None])[0].tolist()
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]], dtype=torch.float64)
    means = scale * (scene.means.double() @ turn.T) + torch.tensor(move, dtype=torch.float64)
    return replace(
        scene,
        means=means.to(dtype),
        quats=(scene.quats.double() @ left.T).to(dtype),
        log_scales=scene.log_scales + torch.tensor(scale, dtype=torch.float64).log().to(dtype),
        sh=sh_turned(scene.sh, turn),
        filter_3d=None if scene.filter_3d is None else scene.filter_3d * scale,
    )


def box_of(scene: Gaussians, sigmas: float) -> Float[Tensor, "2 3"]:
    """Smallest and largest coordinates of the Gaussians to so many standard deviations of each one's longest axis."""
    reach = sigmas * scene.scales.amax(dim=1, keepdim=True)
    return torch.stack([(scene.means - reach).amin(dim=0), (scene.means + reach).amax(dim=0)])
