"""The visible share of each Gaussian in a scene's views, past those in front of it.

Merging may change hidden Gaussians at no cost, and a level leaves out those that no view shows.  A splat adds the light
Σ T α to an image, with the transmittance T before it.  This is the gradient of the sum of all pixels with respect to
its colour.  Divided by the light that the splat would add alone, it is the splat's mean transmittance.  Alone it would
add the part of 2π √det (o - c) that lies in the image, because alphas below the cut-off c are not drawn.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import free_views
from aaplug.core.cameras import Camera, spread
from aaplug.core.colours import BLACK
from aaplug.core.splats import Splats2D
from aaplug.rendering.renderer import Renderer
from aaplug.system.monitor import Tell

MAX_VIEWS = 100  # half of them training poses, half free ones between these


def visibility(
    look: Renderer, poses: Sequence[Camera], scale: float, tell: Tell = lambda done, total: None
) -> Float[Tensor, " n"]:
    """Mean transmittance in front of each Gaussian of `look`'s scene, in the view that shows most of it.

    NaN for a Gaussian of which nothing is known: it lies in no image, or is too faint to be drawn.

    poses: training poses; free ones between them count too.
    scale: of the images, against the poses' size.
    """
    shares = torch.full((len(look.scene),), -1.0)
    views = [*spread(poses, MAX_VIEWS // 2), *spread(free_views(poses, 1), MAX_VIEWS // 2)]
    for number, view in enumerate(views):
        tell(number, len(views))
        camera = view.scaled(scale)
        with torch.no_grad():
            splats = look.splats(camera)
        if not len(splats):
            continue
        with torch.enable_grad():
            colours = splats.means.new_zeros(len(splats), 3).requires_grad_()
            render = look.paint(replace(splats, rgb=colours), camera.hw, BLACK)
            (light,) = torch.autograd.grad(render.rgb[..., 0].sum(), colours)
        share = light[:, 0] / _alone(splats, camera.hw, look.training.convention.rules.min_alpha)
        share = share.clamp(max=1).where(share.isfinite(), -1.0)
        shares[splats.sources] = torch.maximum(shares[splats.sources], share.to(shares))
    return shares.where(shares >= 0, torch.nan)


def _alone(splats: Splats2D, hw: tuple[int, int], min_alpha: float) -> Float[Tensor, " m"]:
    """The light that each splat would add to an empty image, in px²: 0 if its middle lies outside."""
    sides, means = torch.tensor([hw[1], hw[0]]).to(splats.means), splats.means
    sigmas = splats.covs[:, [0, 2]].sqrt()
    inside = torch.special.ndtr((sides - means) / sigmas) - torch.special.ndtr(-means / sigmas)
    part = inside.prod(dim=1) * ((means >= 0) & (means <= sides)).all(dim=1)
    return 2 * math.pi * splats.dets.sqrt() * (splats.opacities - min_alpha).clamp(min=0) * part
