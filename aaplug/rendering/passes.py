"""Passes of a drawn view: depth, normal, position and more, each resolved as its kind demands.

With w_i the weight by which splat i is composited at a sample, w_i = alpha_i T_i, where T_i is the transmittance in
front of it:

- depth, position, bound: expected values Σ w_i x_i / Σ w_i, where both sums are over all samples of a pixel, so that
  what is behind a silhouette does not count.  normal: the same, of length 1.  The depth of a flat splat is here that of
  its plane at the sample, to first order in the way from its centre, and a position lies on the sample's ray at that
  depth; everywhere else depths are of centres.
- depth-median: at a sample the depth of the first splat behind which the transmittance is below a half; at a pixel the
  lower median of its samples, of which those without such a splat are infinitely far.
- depth-nearest: the least depth of a splat that is drawn, over all samples.
- id: of the splat with the largest w_i of all samples.
- samples: evaluations of splats that are drawn, over all samples.

Where nothing is, an id is -1 and everything else 0.  m: splats; h, w: px of the pixels; H, W: of the samples.
"""

from collections.abc import Callable, Collection, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.imaging import average_samples
from aaplug.core.lenses import PINHOLE
from aaplug.core.passes import NormalAxes
from aaplug.core.projection import thinnest_axes, with_depth_slopes
from aaplug.core.sampling import SamplingBounds
from aaplug.core.splats import Render, Splats2D
from aaplug.rasterizers.tiled.order import Shown
from aaplug.system.errors import UsageError

MOST_TILT = 4.0  # growth of depth along a plane over the way across the view: 76°
SIGMAS = 3.0  # standard deviations from a splat's centre to where it ends
TO_VIEWER = (1.0, -1.0, -1.0)  # from axes x right, y down, z forward to y up, z towards the viewer
# of `Order`, that a pass is made of; number and weight are drawn together
STATISTICS = {
    "id": ("number", "weight"),
    "depth-nearest": ("nearest",),
    "depth-median": ("median",),
    "samples": ("count",),
}
MAX_NUMBER = 1 << 24  # up to which float32 holds every whole number


def expected(
    names: Collection[str],
    splats: Splats2D,
    scene: Gaussians,
    bounds: SamplingBounds,
    camera: Camera,
    samples: int,
    weight: float,
    normal_axes: NormalAxes,
    draw: Callable[[Float[Tensor, "m c"]], Render],
) -> dict[str, Float[Tensor, "h w ..."]]:
    """Those passes of `names` that are expected values.

    depth: composited as that at the image's corner, and its growth per px to the right and down.
    normal: the shortest axis, towards the camera.
    bound: the finest rate at which training sampled the Gaussian (`SamplingBounds.highest`) over that of the view's
        pixels; above 1 the view samples more coarsely.

    camera: that of the supersampled image, with so many `samples` along a pixel's side.
    weight: as in `average_samples`.  draw: composites channels, premultiplied.
    """
    sources, depths, channels = splats.sources, splats.depths[:, None], dict[str, Tensor]()
    if {"depth", "position"} & {*names}:
        growth = _growth(splats, scene, camera) if camera.lens == PINHOLE else torch.zeros_like(splats.means)
        channels["depth"] = torch.cat([depths - (growth * splats.means).sum(dim=1, keepdim=True), growth], dim=1)
    if "normal" in names:
        normals = thinnest_axes(scene, sources).to(depths)
        sights = (scene.means.index_select(0, sources).double() - camera.centre.to(depths.device)).to(depths)
        if camera.lens.projection == "ortho":
            sights = camera.cam_from_world[2, :3].to(depths)
        normals = torch.where((normals * sights).sum(dim=1, keepdim=True) > 0, -normals, normals)
        if normal_axes == "camera":
            normals = normals @ camera.cam_from_world[:3, :3].T.to(normals) * normals.new_tensor(TO_VIEWER)
        channels["normal"] = normals
    if "bound" in names:
        rates = camera.focal / depths if splats.rates is None else splats.rates[:, None]
        channels["bound"] = bounds.highest.index_select(0, sources)[:, None].to(depths) * samples / rates
    if not channels:
        return {}
    image = draw(torch.cat([*channels.values()], dim=1))
    parts = image.rgb.split([channel.shape[1] for channel in channels.values()], dim=2)
    layers = dict(zip(channels, parts, strict=True))
    if "depth" in layers:
        height, width = image.alpha.shape
        x, y = (torch.arange(side).to(image.alpha) + 0.5 for side in (width, height))
        at_corner, right, down = layers["depth"].unbind(dim=2)
        layers["depth"] = along = (at_corner + x * right + y[:, None] * down)[..., None]
        if "position" in names:
            rays = camera.rays(torch.stack(torch.broadcast_tensors(x, y[:, None]), dim=2))
            if camera.lens.projection == "ortho":
                flat = image.alpha[..., None]
                along = torch.cat([flat, flat, along], dim=2)
            layers["position"] = (rays * along) @ camera.cam_from_world[:3, :3].to(rays)
    layers = {name: layer for name, layer in layers.items() if name in names}
    image = average_samples(Render(torch.cat([*layers.values()], dim=2), image.alpha), samples, weight)
    covered = image.alpha[..., None] > 0
    means = torch.where(covered, image.rgb / image.alpha[..., None], 0.0)
    found = dict(zip(layers, means.split([layer.shape[2] for layer in layers.values()], dim=2), strict=True))
    if "normal" in found:
        found["normal"] = normalize(found["normal"], dim=2)
    if "position" in found:
        found["position"] = torch.where(covered, found["position"].double() + camera.centre.to(means.device), 0.0).to(
            means
        )
    return {name: part if part.shape[2] > 1 else part[..., 0] for name, part in found.items()}


def composited(
    splats: Splats2D, channels: Float[Tensor, "m d"], draw: Callable[[Splats2D], Render], per_call: Sequence[int]
) -> Render:
    """Premultiplied channels of splats beside their colours, composited as colours are, and alpha.

    d: channels.  draw: composites coloured splats over black.  per_call: numbers of channels, one of which is drawn at
        a time.
    """
    width = channels.shape[1]
    at_once = min(per_call, key=lambda count: -(-width // count))
    parts = pad(channels, (0, -width % at_once)).split(at_once, dim=1)
    images = [draw(splats.with_columns({"rgb": part})) for part in parts]
    planes = [image.rgb.movedim(2, 0) for image in images]  # as they lie in memory
    planes[-1] = planes[-1][: width - at_once * (len(planes) - 1)]
    return Render(torch.cat(planes).movedim(0, 2), images[0].alpha)


def _growth(splats: Splats2D, scene: Gaussians, camera: Camera) -> Float[Tensor, "m 2"]:
    """Growth of depth on each splat's plane, in world units per px to the right and down.

    The plane counts as far as the splat is flat; a ball has none.  Its tilt is at most `MOST_TILT`, and what it adds
    within the splat at most half of the depth.
    """
    shortest, middle, _ = scene.scales.sort(dim=1).values.index_select(0, splats.sources).unbind(dim=1)
    slopes = with_depth_slopes(splats, scene, camera).depth_slopes
    assert slopes is not None
    slopes = slopes * (1 - (shortest / middle).square())[:, None]
    radii = SIGMAS * (splats.covs[:, 0] + splats.covs[:, 2]).sqrt()
    most = (0.5 / radii).clamp(max=MOST_TILT / camera.focal)
    lengths = slopes.norm(dim=1).clamp(min=torch.finfo(slopes.dtype).tiny)
    return slopes * (splats.depths * (most / lengths).clamp(max=1.0))[:, None]


def by_order(
    names: Collection[str], splats: Splats2D, samples: int, draw: Callable[[Splats2D, Shown], Render]
) -> dict[str, Float[Tensor, "h w"] | Int[Tensor, "h w"]]:
    """Those passes of `names` that hang on the order of splats along a ray.

    samples: along a pixel's side.  draw: composites by `Order`, which shows these statistics.

    Raises UsageError if the view has more splats than float32 has whole numbers.
    """
    shown = [statistic for name, needed in STATISTICS.items() if name in names for statistic in needed]
    if not shown:
        return {}
    if len(splats) > MAX_NUMBER:
        raise UsageError("passes", f"by order serve up to {MAX_NUMBER:,} splats in view, not {len(splats):,}")
    places = torch.arange(len(splats), device=splats.means.device)
    numbered = torch.stack([splats.depths, places.to(splats.depths), torch.zeros_like(splats.depths)], dim=1)
    splats = splats.with_columns({"rgb": numbered})

    found = dict[str, Float[Tensor, "h w s"]]()
    for start in range(0, len(shown), 4):
        a, b, c, d = (shown[start : start + 4] * 4)[:4]
        image = draw(splats, (a, b, c, d))
        planes = torch.stack([*image.rgb.unbind(dim=2), image.alpha])
        boxes = planes.unflatten(2, (-1, samples)).unflatten(1, (-1, samples)).transpose(2, 3).flatten(3)
        found |= dict(zip((a, b, c, d), boxes, strict=True))
    resolved = dict[str, Tensor]()
    if "id" in names:
        place = found["number"].gather(2, found["weight"].argmax(dim=2, keepdim=True)).squeeze(2).long()
        resolved["id"] = torch.cat([splats.sources, splats.sources.new_full((1,), -1)])[place]  # the last: no splat
    if "depth-nearest" in names:
        resolved["depth-nearest"] = found["nearest"].amin(dim=2)
    if "depth-median" in names:
        resolved["depth-median"] = found["median"].median(dim=2).values
    if "samples" in names:
        resolved["samples"] = found["count"].sum(dim=2)
    return {name: plane.masked_fill(plane == torch.inf, 0) for name, plane in resolved.items()}
