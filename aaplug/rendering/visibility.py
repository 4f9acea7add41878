"""How much of each Gaussian a scene's views show, past those in front of it.

Merging may change what is hidden at no cost, and a level leaves out what no view shows.  The light that a splat adds
to an image, Σ T α with the transmittance T before it, is the gradient of the sum of all pixels with respect to its
colour.  Over the light that it would add alone, this is its mean transmittance.  Alone it would add the part of
2π √det (o - c) that lies in the image, as alphas below the cut-off c are not drawn.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import BLACK, Camera, spread
from aaplug.core.free_views import free_views
from aaplug.core.monitor import Tell
from aaplug.core.splats import Splats2D
from aaplug.rendering.renderer import Renderer

VIEWS = 100  # half of them training poses, half free ones between these, as far as there are so many


def visibility(
    look: Renderer, poses: Sequence[Camera], scale: float, tell: Tell = lambda done, total: None
) -> Float[Tensor, " n"]:
    """Mean transmittance in front of each Gaussian of `look`'s scene, in the view that shows most of it.

    It is NaN for a Gaussian that lies in no image, and where it is too faint to be drawn: nothing is known of it.

    poses: training poses; free ones between them count too.
    scale: of the images, against the poses' size.
    """
    found = torch.full((len(look.scene),), -1.0)
    views = [*spread(poses, VIEWS // 2), *spread(free_views(poses, 1), VIEWS // 2)]
    for number, view in enumerate(views):
        tell(number, len(views))
        camera = view.scaled(scale)
        splats, light = _light(look, camera)
        share = light / _alone(splats, camera.hw, look.training.convention.rules.min_alpha)
        share = share.clamp(max=1).where(share.isfinite(), -1.0)
        found[splats.sources] = torch.maximum(found[splats.sources], share.to(found))
    return found.where(found >= 0, torch.nan)


def _alone(splats: Splats2D, hw: tuple[int, int], min_alpha: float) -> Float[Tensor, " m"]:
    """What each splat would add to an empty image: 0 if its middle lies outside."""
    sides, means = torch.tensor([hw[1], hw[0]]).to(splats.means), splats.means
    sigmas = splats.covs[:, [0, 2]].sqrt()
    inside = torch.special.ndtr((sides - means) / sigmas) - torch.special.ndtr(-means / sigmas)
    part = inside.prod(dim=1) * ((means >= 0) & (means <= sides)).all(dim=1)
    return 2 * math.pi * splats.dets.sqrt() * (splats.opacities - min_alpha).clamp(min=0) * part


def _light(look: Renderer, camera: Camera) -> tuple[Splats2D, Float[Tensor, " m"]]:
    """The splats of a view, and the light that each adds to its image: px² where it covers them fully."""
    with torch.no_grad():
        splats = look.splats(camera)
    if not len(splats):
        return splats, splats.opacities
    with torch.enable_grad():
        colours = splats.means.new_zeros(len(splats), 3).requires_grad_()
        recipe, rules = look.recipe, look.training.convention.rules
        painted = replace(splats, rgb=colours)
        render = look.rasterizer(painted, camera.hw, BLACK, recipe.pixel, recipe.compositor, rules)
        (light,) = torch.autograd.grad(render.rgb[..., 0].sum(), colours)
    return splats, light[:, 0]
