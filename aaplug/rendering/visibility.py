"""The visible share of each Gaussian in a scene's views, past those in front of it.

Merging may change hidden Gaussians at no cost, and a level leaves out those that no view shows.
"""

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import free_views
from aaplug.core.cameras import Camera, spread
from aaplug.core.colours import BLACK
from aaplug.core.light import transmittances
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
        paint = partial(look.paint, hw=camera.hw, background=BLACK)
        share = transmittances(splats, camera, look.training.convention.rules.min_alpha, paint).nan_to_num(-1.0)
        originals = ~splats.are_copies
        rows, share = splats.sources[originals], share[originals].to(shares)
        shares[rows] = torch.maximum(shares[rows], share)
    return shares.where(shares >= 0, torch.nan)
