"""How much of each Gaussian a scene's views show, past those in front of it.

Merging may change what is hidden at no cost, and a level leaves out what no view shows.  The light that a splat adds
to an image, Σ T α with the transmittance T before it, is the gradient of the sum of all pixels with respect to its
colour.  Over the light that it would add alone, 2π o √det, this is its mean transmittance.
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

VIEWS = 100  # training poses and free ones together
FREE = 3  # free poses for each training pose; `VIEWS` of all are taken


def visibility(
    look: Renderer, poses: Sequence[Camera], scale: float, tell: Tell = lambda done, total: None
) -> Float[Tensor, " n"]:
    """Mean transmittance in front of each Gaussian of `look`'s scene, in the view that shows most of it.

    It is 0 for a Gaussian that no view shows.

    poses: training poses; free ones between them count too.
    scale: of the images, against the poses' size.
    """
    found = torch.zeros(len(look.scene))
    views = spread([*poses, *free_views(poses, FREE)], VIEWS)
    for number, view in enumerate(views):
        tell(number, len(views))
        splats, light = _light(look, view.scaled(scale))
        alone = 2 * math.pi * splats.opacities * splats.dets.sqrt()
        share = (light / alone.clamp(min=torch.finfo(alone.dtype).tiny)).clamp(0, 1)
        found[splats.sources] = torch.maximum(found[splats.sources], share.to(found))
    return found


def _light(look: Renderer, camera: Camera) -> tuple[Splats2D, Float[Tensor, " m"]]:
    """The splats of a view, and the light that each adds to its image: px² where it covers them fully."""
    with torch.no_grad():
        splats = look.splats(camera)
    with torch.enable_grad():
        colours = torch.zeros_like(splats.means[:, :1]).expand(-1, 3).contiguous().requires_grad_()
        recipe, rules = look.recipe, look.training.convention.rules
        painted = replace(splats, rgb=colours)
        render = look.rasterizer(painted, camera.hw, BLACK, recipe.pixel, recipe.compositor, rules)
        (light,) = torch.autograd.grad(render.rgb[..., 0].sum(), colours)
    return splats, light[:, 0]
