"""gsplat's `rasterization_2dgs`; see the package's docstring."""

from dataclasses import replace
from typing import Annotated, Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.cameras import Side
from aaplug.core.conventions import CLASSIC
from aaplug.core.interfaces import Rasterizer
from aaplug.core.rules import RULES_GSPLAT
from aaplug.gsplat.arguments import Options, refuse, views_of
from aaplug.gsplat.discs import Discs, distortion, median_depth, normals_of_depth, splats_of
from aaplug.gsplat.drawing import drawer, features_of, finished, rasterizer_of
from aaplug.gsplat.drop_in import Above0, From0, Kernel, MaxAlpha
from aaplug.gsplat.table import Layout
from aaplug.methods.pixel_kernels.surfel import SURFEL
from aaplug.rasterizers.choice import kernels_of
from aaplug.rendering.passes import composited
from aaplug.system.contracts import Range, contract
from aaplug.system.cores import on_free_cores


@contract
def rasterization_2dgs(
    means: Float[Tensor, "*b n 3"],
    quats: Float[Tensor, "*b n 4"],
    scales: Float[Tensor, "*b n 3"],
    opacities: Float[Tensor, "*b n"],
    colors: Float[Tensor, "..."],
    viewmats: Float[Tensor, "*b c 4 4"],
    Ks: Float[Tensor, "*b c 3 3"],
    width: Side,
    height: Side,
    near_plane: Above0 = RULES_GSPLAT.near,
    far_plane: Above0 = 1e10,
    radius_clip: From0 = 0.0,
    eps2d: Kernel = CLASSIC.kernel,
    sh_degree: Annotated[int, Range(0, 4)] | None = None,
    packed: bool = False,
    tile_size: Annotated[int, Range(1)] | None = 16,
    backgrounds: Float[Tensor, "*b c d"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool | None = False,
    absgrad: bool | None = False,
    distloss: bool = False,
    depth_mode: str = "expected",
    *,
    max_alpha: MaxAlpha = RULES_GSPLAT.max_alpha,
    rasterizer: str | Rasterizer = "auto",
    **others: object,
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, dict[str, Any]]:
    """Draw 2D Gaussians into the images of several pinhole cameras, as `gsplat.rasterization_2dgs` does.

    A 2D Gaussian is a disc: its quaternion and first two scales.  Rays meet it exactly, beside a low-pass filter of
    √½ px around its projected centre (2DGS, eqs. 10 and 11).  Differentiable in everything but `Ks`, as gsplat is.

    Args:
        distloss: compute the distortion, which takes two more images in float64; else it is 0.
        depth_mode: depth that surface normals are made of: "expected", the last channel of the image, or "median".
        eps2d, tile_size: without effect.
        sparse_grad, absgrad: only gsplat's defaults are supported.
        max_alpha, rasterizer, others, and the rest: as in `rasterization`.

    Returns:
        Images [..., c, height, width, channels], alpha [..., c, height, width, 1], normals of discs, composited, in the
        world's frame [..., c, height, width, 3], normals of the depth image where `render_mode` has colours and depth
        [..., c, height, width, 3] without a first dimension of 1, else None, distortion and median depth
        [..., c, height, width, 1], and `meta` with gsplat's keys, except those of its tiles.  `meta["gradient_2dgs"]`
        has the gradient that gsplat's densification reads.

    Raises:
        UsageError: as `rasterization`; also, there is no such `depth_mode`.
    """
    refuse({"sparse_grad": sparse_grad, "absgrad": absgrad, **others})
    options = Options(
        *(width, height, near_plane, far_plane, radius_clip, eps2d, sh_degree, tile_size or 16, render_mode),
        *("classic", "classic", max_alpha),
        depth_mode=depth_mode,
    )
    views = views_of(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, None, None, options)
    painter = rasterizer_of(rasterizer, means.dtype, means.device.type) if isinstance(rasterizer, str) else rasterizer
    parts = [Discs.of(view, options) for view in views]
    layout = Layout.of([part.sources for part in parts], viewmats.shape[:-2], means.shape[-2], packed)
    transforms = layout.column([part.transforms for part in parts])
    # Added to the centres, in px, this gets the gradient that a move of each disc across the image has.
    gradient = torch.zeros_like(transforms[..., 0, :2], requires_grad=transforms.requires_grad)
    meta = layout.facts(options) | {
        "radii": layout.column([part.radii for part in parts]),
        "depths": layout.column([part.depths for part in parts]),
        "ray_transforms": transforms,
        "opacities": layout.column([part.opacities for part in parts]),
        "normals": layout.column([part.normals for part in parts]),
        "gradient_2dgs": gradient,
    }
    splats = [
        splats_of(part, transform + functional.pad((transform[:, 2:, 2] * move)[..., None], (2, 0, 0, 1)))
        for part, transform, move in zip(parts, layout.split(transforms), layout.split(gradient), strict=True)
    ]
    meta["means2d"] = layout.column([part.means for part in splats])
    images, surfaces, kernels = [], list[Tensor](), kernels_of(painter)
    for part, means, discs, view in zip(splats, layout.split(meta["means2d"]), parts, views, strict=True):
        with on_free_cores():
            part = replace(part, means=means)
            features = features_of(part, view, options, kernels)
            channels = torch.cat([features, discs.normals], dim=1)
            image = composited(part, channels, drawer(painter, options, SURFEL), (3,))
            alpha = image.alpha[..., None]
            image, normals = image.rgb.split([features.shape[1], 3], dim=2)
            image = finished(image, alpha, view, options)
            median = median_depth(part, options, painter)
            if options.coloured and options.render_mode != "RGB":
                surfaces.append(normals_of_depth(median if depth_mode == "median" else image[..., -1:], view.camera))
            normals = normals @ torch.linalg.inv(view.camera.cam_from_world[:3, :3]).T.to(normals)
            distort = distortion(part, options, painter) if distloss else torch.zeros_like(alpha)
            images.append((image, alpha, normals, distort, median))
    colours, alphas, normals, distort, median = (
        torch.stack(column).unflatten(0, layout.shape) for column in zip(*images, strict=True)
    )
    meta["render_distort"] = distort
    surface = torch.stack(surfaces).unflatten(0, layout.shape).squeeze(0) if surfaces else None
    return colours, alphas, normals, surface, distort, median, meta
