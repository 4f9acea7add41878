"""The splats of one image by gsplat's rules: the screen filter, which splats count, and their radii.

m: splats.
"""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.ellipses import squared_cutoff
from aaplug.core.kernels import Kernels
from aaplug.core.projection import project, project_covariances
from aaplug.core.sampling import SamplingBounds
from aaplug.core.shading import shade
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.gsplat.arguments import Options, View
from aaplug.methods.filters import Matched

# gsplat's factor has no floor; this one only keeps the gradient of the root finite where the factor is 0
NO_FLOOR = 1e-9
LARGEST_RADIUS = 2.0**30  # px; fits 32 bits

NONE = torch.zeros(0)
UNSEEN = SamplingBounds(NONE, NONE, NONE, NONE.int())


class Seen(NamedTuple):
    """The splats of one image, and half the sides of their bounding boxes along x and y, in px."""

    splats: Splats2D
    radii: Int[Tensor, "m 2"]


def seen(view: View, options: Options, kernels: Kernels) -> Seen:
    """The splats that gsplat keeps, without colour.

    It drops what lies beyond a plane, has an opacity below 1/255, a radius of at most `radius_clip` along both axes, or
    a box outside of the image.
    """
    rules, camera = options.convention.rules, view.camera
    if view.covars is None:
        splats = project(view.scene, camera, kernels, rules)
        splats = replace(splats, opacities=view.opacities.index_select(0, splats.sources))
    else:
        splats = project_covariances(view.scene.means, view.covars, view.opacities, camera, rules)
    splats = filtered(splats, view, options)
    with torch.no_grad():
        radii = _radii(splats, rules.min_alpha)
    low, high = splats.means - radii, splats.means + radii
    kept = (splats.depths <= options.far_plane) & (splats.opacities >= rules.min_alpha) & (splats.dets > 0)
    kept = kept & (radii > options.radius_clip).any(dim=1)
    kept = kept & (high > 0).all(dim=1) & (low < low.new_tensor([options.width, options.height])).all(dim=1)
    return Seen(splats[kept], radii[kept].int())


def filtered(splats: Splats2D, view: View, options: Options) -> Splats2D:
    """The splats after the screen filter of `rasterize_mode`."""
    if options.rasterize_mode == "matched":
        training = TrainingViews(options.convention, [view.camera], UNSEEN)
        return Matched("global")(splats, view.camera, training)
    return splats.blurred(options.eps2d, options.convention.compensated, NO_FLOOR)


def features_of(splats: Splats2D, view: View, options: Options, kernels: Kernels) -> Float[Tensor, "m d"]:
    """Colours, then depth, as far as `render_mode` draws them."""
    parts = []
    if options.coloured and view.features is not None:
        parts.append(view.features.index_select(0, splats.sources))
    elif options.coloured:
        parts.append(shade(splats, view.scene, view.camera, kernels).rgb)
    if options.render_mode != "RGB":
        parts.append(splats.depths[:, None])
    return torch.cat(parts, dim=1)


def _radii(splats: Splats2D, min_alpha: float) -> Float[Tensor, "m 2"]:
    """Whole px, as far as alpha reaches `min_alpha`."""
    reach = squared_cutoff(splats.opacities, min_alpha).clamp(min=0.0).sqrt()
    return (reach[:, None] * splats.covs[:, ::2].sqrt()).ceil().clamp(max=LARGEST_RADIUS)
