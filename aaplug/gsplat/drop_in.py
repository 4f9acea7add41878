"""The function itself; see the package's docstring."""

from dataclasses import replace
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from aaplug.core.cameras import Side
from aaplug.core.conventions import CLASSIC, MAX_KERNEL
from aaplug.core.interfaces import Rasterizer, RunsKernels
from aaplug.core.rules import RULES_GSPLAT
from aaplug.gsplat.arguments import Options, check_shape, refuse, views_of
from aaplug.gsplat.drawing import drawer, features_of, finished, rasterizer_of, splats_of
from aaplug.gsplat.table import Layout, conics
from aaplug.methods.pixel_kernels.absolute import AbsolutePoint
from aaplug.methods.pixel_kernels.point import POINT
from aaplug.rasterizers.choice import CHANNELS, channels_at_once, kernels_of
from aaplug.rendering.passes import composited
from aaplug.system.contracts import Range, contract
from aaplug.system.cores import on_free_cores
from aaplug.system.errors import UsageError

Above0 = Annotated[float, Range(above=0)]
From0 = Annotated[float, Range(0)]
Kernel = Annotated[float, Range(0, MAX_KERNEL)]
MaxAlpha = Annotated[float, Range(above=RULES_GSPLAT.min_alpha, most=1 - 1e-6)]


@contract
def rasterization(
    means: Float[Tensor, "*b n 3"],
    quats: Float[Tensor, "*b n 4"] | None,
    scales: Float[Tensor, "*b n 3"] | None,
    opacities: Float[Tensor, "*b n"],
    colors: Float[Tensor, "..."] | None,
    viewmats: Float[Tensor, "*b c 4 4"],
    Ks: Float[Tensor, "*b c 3 3"],
    width: Side,
    height: Side,
    near_plane: Above0 = RULES_GSPLAT.near,
    far_plane: Above0 = 1e10,
    radius_clip: From0 = 0.0,
    eps2d: Kernel = CLASSIC.kernel,
    sh_degree: Annotated[int, Range(0, 4)] | None = None,
    packed: bool = True,
    tile_size: Annotated[int, Range(1)] | None = 16,
    backgrounds: Float[Tensor, "*b c d"] | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool | None = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    channel_chunk: int = 32,
    distributed: bool | None = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Float[Tensor, "*b n 3 3"] | None = None,
    with_ut: bool | None = False,
    with_eval3d: bool | None = False,
    radial_coeffs: Float[Tensor, "*b c radial"] | None = None,
    tangential_coeffs: Float[Tensor, "*b c 2"] | None = None,
    thin_prism_coeffs: Float[Tensor, "*b c 4"] | None = None,
    *,
    global_z_order: bool = True,
    masks: Bool[Tensor, "*b c h w"] | None = None,
    relative_rate: float | Float[Tensor, "..."] | None = None,
    trained_mode: str = "classic",
    max_alpha: MaxAlpha = RULES_GSPLAT.max_alpha,
    rasterizer: str | Rasterizer = "auto",
    **others: object,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw Gaussians into the images of several cameras, as `gsplat.rasterization` does.

    n: Gaussians; c: cameras; k: spherical-harmonics coefficients per channel; d: channels; "...": batch dimensions, or
    none.  Differentiable in everything but `Ks` and distortion, as gsplat is.  `meta["means2d"]` has the gradients that
    gsplat's densification reads; the gradients of the other entries are not recorded there.

    Args:
        means: [..., n, 3], in world units.
        quats: wxyz, of any length; one of length zero turns nothing; [..., n, 4].
        scales: standard deviations, [..., n, 3], in world units.
        opacities: in [0, 1], [..., n].
        colors: channels, [..., n, d] or [..., c, n, d]; with `sh_degree` coefficients, [..., n, k, 3] or
            [..., c, n, k, 3].  None where only depth is drawn.
        viewmats: from world to camera (x right, y down, z forward), [..., c, 4, 4].
        Ks: intrinsics in px, [..., c, 3, 3].
        width, height: px.
        near_plane, far_plane: depths between which Gaussians are drawn, in world units.
        radius_clip: px; splats with no larger radius are not drawn.
        eps2d: px²; variance added to every projected covariance.
        sh_degree: degree of the harmonics to use; None for plain channels.
        packed: lay `meta` out by splat, not by camera and Gaussian.
        backgrounds: [..., c, d]; black if None.  Depth has none.
        render_mode: "RGB", colours; "D" or "ED", depth summed by weight or expected; "RGB+D" or "RGB+ED", both, with
            depth as the last channel.
        absgrad: the backward pass sets `meta["means2d"].absgrad` (arXiv 2404.10484).
        rasterize_mode: "classic"; "antialiased", which also scales opacity by √(det C / det(C + eps2d·I)), without a
            floor; or aaplug's "matched", which draws at any rate what training drew at its own (`Matched`).
        tile_size, channel_chunk, segmented: without effect here.
        sparse_grad, distributed, with_eval3d: only gsplat's defaults are supported.
        camera_model: "pinhole"; "fisheye", equidistant, whose focal lengths are px per radian; or "ortho", px per world
            unit.  A Gaussian is drawn as the ellipse that the lens, linearised at its centre, makes of it (EWA
            splatting).  As in gsplat, a fisheye shows nothing behind the near plane, so 180° at most.
        with_ut: without effect; the linearisation takes the place of the unscented transform.
        radial_coeffs: OpenCV's k1 to k6 of a pinhole, [..., c, 6], or k1 to k4 of a fisheye, [..., c, 4].
        tangential_coeffs: OpenCV's p1, p2 of a pinhole, [..., c, 2].
        thin_prism_coeffs: OpenCV's s1 to s4 of a pinhole, [..., c, 4].
        global_z_order: depth is that along the optical axis; if False, the distance from the camera.
        masks: False for pixels of an image that are left black, as gsplat's trainer does, [..., c, height, width].
        covars: [..., n, 3, 3], in squared world units, instead of quats and scales; the upper triangle is read.
        relative_rate: for "matched": each image's focal length over training's, one number or [..., c].
        trained_mode: for "matched": "classic" or "antialiased", the mode of training.
        max_alpha: cap of one splat's alpha at a pixel; 0.999 in gsplat 1.5, 0.99 in 1.6.
        rasterizer: a rasterizer of aaplug, or its name.  "compiled" composites by compiled kernels or not at all.
        others: further arguments of gsplat's, of which only the defaults are supported.

    Returns:
        Images [..., c, height, width, channels], alpha [..., c, height, width, 1], and `meta` with gsplat's keys,
        except those of its tiles.

    Raises:
        UsageError: something is not supported or out of range, shapes do not fit each other, memory does not hold an
            image, or no compiled kernel takes what "compiled" was asked for.
    """
    options = Options(
        *(width, height, near_plane, far_plane, radius_clip, eps2d, None if colors is None else sh_degree),
        *(tile_size or 16, render_mode, rasterize_mode, trained_mode, max_alpha, global_z_order, camera_model),
    )
    refuse({"sparse_grad": sparse_grad, "distributed": distributed, "with_eval3d": with_eval3d, **others})
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, covars)
    views = views_of(*tensors, relative_rate, options, (radial_coeffs, tangential_coeffs, thin_prism_coeffs))
    painter = rasterizer_of(rasterizer, means.dtype, means.device.type) if isinstance(rasterizer, str) else rasterizer
    if absgrad and not isinstance(painter, RunsKernels):
        raise UsageError("absgrad", f"rasterizer {painter.name} sums no absolute gradients")
    kernels = kernels_of(painter)
    splats, radii = zip(*(splats_of(view, options, kernels) for view in views), strict=True)
    layout = Layout.of([part.sources for part in splats], viewmats.shape[:-2], means.shape[-2], packed)
    meta = layout.facts(options) | {
        "radii": layout.column(radii),
        "means2d": layout.column([part.means for part in splats]),
        "depths": layout.column([part.depths for part in splats]),
        "conics": layout.column([conics(part) for part in splats]),
        "opacities": layout.column([part.opacities for part in splats]),
    }
    # read from the table, so that gradients of images pass through it
    columns = zip(splats, *(layout.split(meta[name]) for name in ("means2d", "depths", "opacities")), strict=True)
    splats = [replace(part, means=means, depths=z, opacities=opacity) for part, means, z, opacity in columns]
    adders = layout.gradient_adders(meta["means2d"]) if absgrad else len(views) * [None]
    images = []
    for part, view, add in zip(splats, views, adders, strict=True):
        with on_free_cores():
            features = features_of(part, view, options, kernels)
            inputs = (part.means, part.covs, part.opacities, features)
            gradients = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
            pixel, per_call = POINT, channels_at_once(painter, POINT, gradients)
            if gradients and add is not None:  # of all channels: absolute values of a few at a time do not add up
                pixel, per_call = AbsolutePoint(absolute_gradients_to=add), [max(CHANNELS, features.shape[1])]
            image = composited(part, features, drawer(painter, options, pixel), per_call)
            alpha = image.alpha[..., None]
            images.append((finished(image.rgb, alpha, view, options), alpha))
    colours, alphas = (
        torch.stack([image.contiguous() for image in column]).unflatten(0, layout.shape)
        for column in zip(*images, strict=True)
    )
    if masks is not None:
        check_shape("masks", masks, colours.shape[:-1])
        colours = colours * masks[..., None]
    return colours, alphas, meta
