"""One image by gsplat's rules: which splats it keeps, their channels, and the rasterizer that draws them.

m: splats of the image; d: channels, of which the first are colours; h, w: px.
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.colours import BLACK
from aaplug.core.ellipses import squared_cutoff
from aaplug.core.imaging import over
from aaplug.core.interfaces import PixelKernel, Rasterizer
from aaplug.core.kernels import Kernel, Kernels, Runner
from aaplug.core.lenses import PINHOLE
from aaplug.core.projection import project, project_covariances, rotation_matrices
from aaplug.core.sampling import SamplingBounds
from aaplug.core.shading import shade
from aaplug.core.splats import Render, Splats2D
from aaplug.core.training import TrainingViews
from aaplug.gsplat.arguments import Options, View
from aaplug.methods.filters.matched import Matched
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.choice import find_rasterizer
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.on_demand import BUILT_BY_NAME
from aaplug.system.contracts import described
from aaplug.system.errors import UsageError

MIN_COMPENSATION = 1e-9  # gsplat has none; this one keeps the gradient of the root finite where the factor is 0
MAX_RADIUS = 2.0**30  # px; fits 32 bits
MIN_ALPHA_OF_DEPTH = 1e-10  # expected depth is divided by no less

_EMPTY = torch.zeros(0)
NO_BOUNDS = SamplingBounds(_EMPTY, _EMPTY, _EMPTY, _EMPTY.int())
log = logging.getLogger("aaplug")


def splats_of(view: View, options: Options, kernels: Kernels) -> tuple[Splats2D, Int[Tensor, "m 2"]]:
    """The splats that gsplat keeps, after the screen filter of `rasterize_mode`, and half the sides of their boxes.

    It drops what lies beyond a plane, has an opacity below 1/255, a radius of at most `radius_clip` along both
    axes, or a box outside of the image.  Sides are along x and y, in px.
    """
    rules, camera = options.convention.rules, view.camera
    if view.covars is None and camera.lens == PINHOLE:
        splats = project(view.scene, camera, kernels, rules)
        splats = replace(splats, opacities=view.opacities.index_select(0, splats.sources))
    else:
        sigma = view.covars
        if sigma is None:
            factor = rotation_matrices(view.scene.unit_quats.double()) * view.scene.scales.double()[:, None]
            sigma = factor @ factor.mT
        splats = project_covariances(view.scene.means, sigma, view.opacities, camera, rules)
    if options.rasterize_mode == "matched":
        splats = Matched("global")(splats, camera, TrainingViews(options.convention, [camera], NO_BOUNDS))
    else:
        splats = splats.blurred(options.eps2d, options.convention.compensated, MIN_COMPENSATION)
    with torch.no_grad():
        reach = squared_cutoff(splats.opacities, rules.min_alpha).clamp(min=0.0).sqrt()
        radii = (reach[:, None] * splats.covs[:, ::2].sqrt()).ceil().clamp(max=MAX_RADIUS)
    keep = (splats.depths <= options.far_plane) & (splats.opacities >= rules.min_alpha) & (splats.dets > 0)
    keep = keep & options.shows(splats.means, radii)
    splats = splats[keep]
    if not options.global_z_order:
        offsets = view.scene.means.index_select(0, splats.sources).double() - camera.centre
        splats = replace(splats, depths=torch.linalg.vector_norm(offsets, dim=1).to(splats.depths))
    return splats, radii[keep].int()


def features_of(splats: Splats2D, view: View, options: Options, kernels: Kernels) -> Float[Tensor, "m d"]:
    """Colours and depth of each splat, as far as `render_mode` draws them."""
    parts = []
    if options.coloured and view.features is not None:
        parts.append(view.features.index_select(0, splats.sources))
    elif options.coloured:
        parts.append(shade(splats, view.scene, view.camera, kernels).rgb)
    if options.render_mode != "RGB":
        parts.append(splats.depths[:, None])
    return torch.cat(parts, dim=1)


def drawer(rasterizer: Rasterizer, options: Options, pixel: PixelKernel) -> Callable[[Splats2D], Render]:
    """The function that composites splats over black by a pixel kernel."""
    return lambda splats: rasterizer(splats, options.hw, BLACK, pixel, None, options.convention.rules)


def finished(image: Float[Tensor, "h w d"], alpha: Float[Tensor, "h w 1"], view: View, options: Options) -> Tensor:
    """The channels of `features_of` over the background, and depth divided by alpha where it is to be expected."""
    if view.background is not None and options.coloured:
        image = over(image, alpha[..., 0], view.background).rgb
    if options.render_mode.endswith("ED"):
        colours, depth = image.movedim(2, 0).split([image.shape[2] - 1, 1])  # as they lie in memory
        depth = depth / alpha.movedim(2, 0).clamp(min=MIN_ALPHA_OF_DEPTH)
        image = torch.cat([colours, depth]).movedim(0, 2)
    return image


@cache
def rasterizer_of(name: str, precision: torch.dtype, device: str) -> Rasterizer:
    """A rasterizer by name for what a program draws; kernels are loaded and checked once, not for every image.

    precision, device: of the Gaussians; only float32 on the CPU has compiled kernels.
    """
    if name == "auto" and (precision, device) != (torch.float32, "cpu"):
        on_cpu = "float64 is drawn eagerly; kernels are compiled for float32, which is several times as fast"
        elsewhere = f"tensors on {device} are drawn eagerly; gsplat's own kernels are far faster there"
        log.warning(on_cpu if device == "cpu" else elsewhere)
        return RASTERIZERS["eager"]
    found = find_rasterizer(name, None, gradients=True)
    if name != "compiled":
        return found
    assert isinstance(found, Tiled)
    return replace(found, kernels=OnlyCompiled(found.kernels))


class OnlyCompiled(Kernels):
    """Runs kernels as the given ones do, and refuses to composite eagerly."""

    def __init__(self, kernels: Kernels):
        self.kernels, self.name, self.tiles, self.ready = kernels, kernels.name, kernels.tiles, kernels.ready

    def runner(self, kernel: Kernel, args: tuple[Tensor, ...]) -> Runner:
        """The function of a stage; a leading size of 1 is always run eagerly."""
        run = self.kernels.runner(kernel, args)
        whole = all(len(arg) > 1 for arg in args if arg.dim())
        if run is kernel.function and kernel.name.startswith("composite-") and whole:
            problem = f"no kernel '{kernel.name}' is compiled for {described(args[0])}"
            later = ", and compiles it meanwhile" * (kernel.name in BUILT_BY_NAME and args[0].dtype is torch.float32)
            raise UsageError("rasterizer", f'{problem}; "auto" draws it eagerly{later}')
        return run
