"""The scene as leaves that an optimizer moves, 3DGS's learning rates, and the bounds that the leaves keep.

n: Gaussians.  Colours are two leaves, the constant (dc) and the other harmonics (rest), because 3DGS gives them
learning rates of their own.  No Gaussian may become thinner than its sampling bound, or than it was if it was thinner:
no training view could resolve less than √0.2 px at its highest rate (Mip-Splatting, section 5.1).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.sampling import SamplingBounds
from aaplug.methods.filters.smoothing import NYQUIST_VARIANCE

Leaves = dict[str, Tensor]
LEARNED_COLUMNS = "learned"  # leaf of the extras that hold learned filters, if the scene has any
WHOLE = ("means", "quats", "log_scales", "logit_opacities")  # leaves that are columns of the scene

RATES: Mapping[str, float] = {  # 3DGS's, per step; that of the means is a share of the scene's extent
    "means": 1.6e-4,
    "quats": 1e-3,
    "log_scales": 5e-3,
    "logit_opacities": 5e-2,
    "dc": 2.5e-3,
    "rest": 2.5e-3 / 20,
}
SATURATED = 1e3  # a logit or log-scale that looks like an infinite one, in float64 too
EXTENT_MARGIN = 1.1  # times the training cameras' farthest distance from their mean (3DGS)


def leaves_of(scene: Gaussians) -> Leaves:
    """Copies of every parameter; infinite ones become finite numbers of the same look, which steps can average."""
    leaves = {name: getattr(scene, name) for name in WHOLE} | {"dc": scene.sh[:, :1], "rest": scene.sh[:, 1:]}
    if scene.learned:
        leaves[LEARNED_COLUMNS] = torch.stack([scene.extras[name] for name in scene.learned], dim=1)
    ends = {"nan": torch.nan, "posinf": SATURATED, "neginf": -SATURATED}
    return {name: value.detach().nan_to_num(**ends) for name, value in leaves.items()}


def scene_of(leaves: Mapping[str, Tensor], like: Gaussians) -> Gaussians:
    """The scene that the leaves stand for.

    If densification changed the number of Gaussians, the link to the rows of the source file is dropped.
    """
    values = {name: leaves[name] for name in WHOLE}
    sh = torch.cat([leaves["dc"], leaves["rest"]], dim=1)
    if len(sh) != len(like):
        return replace(like, **values, sh=sh, origin=None, extras={})
    learned = zip(like.learned, leaves[LEARNED_COLUMNS].unbind(dim=1), strict=True) if like.learned else ()
    return replace(like, **values, sh=sh, extras={**like.extras, **dict(learned)})


def between(start: Gaussians, end: Gaussians, share: float) -> Gaussians:
    """Interpolate two scenes of equally many Gaussians, parameter by parameter: 0 gives the start, 1 the end."""
    first, last = leaves_of(start), leaves_of(end)
    return scene_of({n: first[n].lerp(last[n], share) for n in first}, end)


def extent(cameras: Sequence[Camera]) -> float:
    """The scene's size in world units, from the spread of its training cameras (3DGS)."""
    centres = torch.stack([camera.centre for camera in cameras])
    spread = (centres - centres.mean(dim=0)).norm(dim=1).max().item()
    return EXTENT_MARGIN * spread if spread > 0 else 1.0


def least_log_scales(first: Float[Tensor, "n 3"], bounds: SamplingBounds) -> Float[Tensor, "n 3"]:
    """ln of the least standard deviation that each axis may take, given the one it had at first."""
    floor = 0.5 * torch.log(torch.tensor(NYQUIST_VARIANCE)) - bounds.highest_or_coarsest.log()
    return torch.minimum(first, floor.to(first)[:, None])
