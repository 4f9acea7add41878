"""The light of a view's splats: how much of each is seen, and how much each has where an exposure spreads it.

A splat adds the light Σ T α to an image, with the transmittance T before it.  This is the gradient of the sum of all
pixels with respect to its colour.  Divided by the light that the splat would add alone, it is the splat's mean
transmittance.  Alone it would add the part of 2π √det (o - c) that lies in the image, because alphas below the cut-off
c are not drawn.

Splats of one surface hide each other.  Spread over each other by an exposure, those that are hidden would add their
light too, and those that are seen would hide each other.  So a spread splat has the light that it adds to the sharp
view.  And as n faint splats that add up to the cover S let e^-S pass instead of 1 - S, it is -ln(1 - S) / S times as
opaque.  m: splats.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.exposures import spread_out
from aaplug.core.sights import plane_rays
from aaplug.core.splats import Render, Splats2D

# Measured: the least share of a splat's light that counts as seen, from one of the N samples or another, over the cube
# root of N; and the most of the cover by other splats that counts: surfaces have edges, which let more pass.
LEAST_SEEN, MOST_COVER = 0.05, 0.8

Paint = Callable[[Splats2D], Render]  # draws splats over black


def transmittances(splats: Splats2D, camera: Camera, min_alpha: float, paint: Paint) -> Float[Tensor, " m"]:
    """Mean transmittance in front of each splat of a view.

    NaN for one that lies in no image or is too faint to be drawn, and for all if `paint` has no gradients.  Through a
    lens, ellipses of the image stand for splats, because their gradients are compiled.
    """
    splats = in_image(splats)
    with torch.enable_grad():
        colours = splats.means.new_zeros(len(splats), 3).requires_grad_()
        total = paint(splats.with_columns({"rgb": colours})).rgb[..., 0].sum()
        if not total.requires_grad:
            return torch.full_like(splats.dets, torch.nan)
        (light,) = torch.autograd.grad(total, colours)
    sides, means = splats.means.new_tensor([camera.width, camera.height]), splats.means
    sigmas = splats.covs[:, [0, 2]].sqrt()
    inside = torch.special.ndtr((sides - means) / sigmas) - torch.special.ndtr(-means / sigmas)
    part = inside.prod(dim=1) * ((means >= 0) & (means <= sides)).all(dim=1)
    alone = 2 * math.pi * splats.dets.sqrt() * (splats.opacities - min_alpha).clamp(min=0) * part
    shares = light[:, 0] / alone
    return torch.where(shares.isfinite(), shares.clamp(max=1), torch.nan)


def in_image(splats: Splats2D) -> Splats2D:
    """Splats in planes of their own as ellipses of the image: the lens is linearised at each centre.

    Pinholes that distort bend splats little, and are steep beyond their image: theirs keep their shapes.  Splats whose
    centre the lens does not see have the opacity 0.
    """
    camera, planes = splats.camera, splats.planes
    if camera is None or planes is None:
        return splats
    (along, middles), lens = plane_rays(planes), camera.lens
    columns = {"opacities": splats.opacities * lens.rays(lens.places(middles)).any(dim=1)}
    if not lens.flat:
        by_place = lens.derivatives(middles) @ along * along.new_tensor([[camera.fx], [camera.fy]])
        covs = by_place @ splats.covs[:, [[0, 1], [1, 2]]] @ by_place.mT
        dets = splats.dets * torch.linalg.det(by_place).square()
        columns |= {"covs": covs.flatten(1)[:, [0, 1, 3]], "dets": dets}
    return replace(splats.with_columns(columns), planes=None, camera=None)


def lights(splats: Splats2D, camera: Camera, min_alpha: float, paint: Paint) -> Float[Tensor, " m"]:
    """Factors of opacity for the splats of a sharp view, if the camera's exposure spreads them without end.

    `spread_out` takes less of them for a splat that is spread less.
    """
    assert camera.exposure is not None
    least = LEAST_SEEN * camera.exposure.samples ** (1 / 3)
    seen = transmittances(splats, camera, min_alpha, paint)
    seen = torch.where(seen.isnan(), seen.nanmean().nan_to_num(1.0), seen).clamp(min=least)
    spread, opacities = spread_out(splats, camera, seen)
    cover = -torch.log1p(-paint(spread).alpha.clamp(max=1.0))
    x, y = (splats.means.long().clamp(min=0).minimum(splats.sources.new_tensor([camera.width, camera.height]) - 1)).T
    others = (cover[y, x] - opacities).clamp(0.0, MOST_COVER)
    return seen * torch.where(others > 0, -torch.log1p(-others) / others, 1.0)
