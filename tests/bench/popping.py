"""Popping: what changes from frame to frame of a turn beyond the motion, by the order in which splats are composited.

Frames are 1° of an orbit apart.  Their FLIP is compared with that of a truth, which sorts the splats of each pixel by
their depth along its ray and takes 16 samples per pixel; what is above the truth's is popping.  Orders: those of
`auto`, by depth and by tile, with several shares of the change of depth (see `splats`); by tile, with runs of `WINDOW`
splats sorted again in each pixel (after StopThePop, Radl et al. 2024, arXiv 2402.00525); and by the depth along each
pixel's ray.  The last two are eager code of this bench.
"""

from dataclasses import replace
from functools import partial
from statistics import mean
from unittest.mock import patch

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import RULES_3DGS, Camera, Colour, Renderer, Splats2D, find_recipe
from aaplug.core import projection, splats
from aaplug.core.camera_paths import median_depth, orbit, up_of
from aaplug.core.imaging import resampled
from aaplug.core.kernels import EAGER
from aaplug.evaluation.metrics import flip
from aaplug.io.photographs import photo_of
from aaplug.methods.pixel_kernels.raster_rows import TILE, tile_centres
from aaplug.rasterizers.tiled.binning import bands
from tests.bench import heading, row, timed
from tests.bench.literature import photographs as photographs_of
from tests.bench.literature import psnr
from tests.bench.scenes import decibels, middle, middle_of, trained

TIMED_SCALES = (1.0, 0.5, 0.25)
DEGREES = 1.0  # of the orbit from frame to frame
FRAMES = 3
TRUTH_SAMPLES = 4  # along a pixel's side
WINDOW = 8  # splats that a pixel sorts again
VALUES_AT_ONCE = 6_000_000  # alphas held at once
TURNS = 15  # frames that are timed, of each order in turn
OWN = splats.NEARER, splats.FARTHER
CASES = (
    ("depth", (0.0, 0.0)),
    ("tile", OWN),
    *(("tile", (share, share)) for share in (0.1, 0.12, 0.15, 0.2, 0.3, 1.0)),
    *((kind, (share, share)) for share in (0.2, 1.0) for kind in ("window", "pixel")),
)


@torch.no_grad()
def main(scene: str = "chair", size: int = 128, photographs: int = 2, whole: int = 8, others: bool = True) -> None:
    """Print popping and PSNR against photographs of the middle of so many px a side; then whole views' PSNR and time.

    others: print other orders and shares than `auto` has.
    """
    opened = trained(scene)
    renderer, background = opened.renderer("matched", rasterizer="eager"), opened.checkpoint.background
    orders = {order: opened.renderer(find_recipe("auto", order=order)) for order in ("depth", "tile")}

    def drawn(camera: Camera, kind: str, shares: tuple[float, float]) -> Float[Tensor, "h w 3"]:
        if kind not in orders:
            return composited(renderer, camera, kind, shares[0], background)
        with patch.multiple(splats, NEARER=shares[0], FARTHER=shares[1]):
            return orders[kind](camera).rgb

    view, up = opened.views(1)[0], up_of(opened.cameras)
    depth = median_depth(opened.scene.means, view)
    turns = [orbit(view, frame * DEGREES / 360, depth, up) for frame in range(FRAMES)]
    frames = [middle(replace(turn, trained_focal=view.trained_focal), size) for turn in turns]
    truth = [
        resampled(
            composited(renderer, f.resized(size * TRUTH_SAMPLES, size * TRUTH_SAMPLES), "pixel", 1.0, background),
            1 / TRUTH_SAMPLES,
            (size, size),
        )
        for f in frames
    ]
    pairs = [(i, i + 1) for i in range(FRAMES - 1)]
    motion = mean(flip(truth[a], truth[b]) or 0.0 for a, b in pairs)
    seen = [middle(v, size) for v in opened.views(photographs)]
    photos = [middle_of(photo_of(v, background)(v), size) for v in opened.views(photographs)]
    heading(f"{scene}, FLIP of the truth's motion: {motion:.4f}", "order", "nearer", "farther", "popping", "PSNR, dB")
    for kind, shares in CASES if others else CASES[:2]:
        images = [drawn(frame, kind, shares) for frame in frames]
        popping = mean(flip(images[a], images[b]) or 0.0 for a, b in pairs) - motion
        close = mean(
            decibels(drawn(camera, kind, shares).clamp(0, 1), photo) for camera, photo in zip(seen, photos, strict=True)
        )
        row(kind, *shares, f"{popping:.5f}", close)
    heading(f"{scene}, whole views", "order", "PSNR, dB", *(f"ms at {scale:g}" for scale in TIMED_SCALES))
    truths = photographs_of(opened, (1.0,), opened.views(whole))
    works = {(order, s): partial(paint, view.scaled(s)) for order, paint in orders.items() for s in TIMED_SCALES}
    times = timed(works, TURNS)
    for order in orders:
        row(order, *psnr(orders[order], truths), *(1000 * times[order, scale] for scale in TIMED_SCALES))


def composited(
    renderer: Renderer, camera: Camera, kind: str, share: float, background: Colour
) -> Float[Tensor, "h w 3"]:
    """A view with splats sorted by tile, then in each pixel: all of them, or in runs."""
    drawn = projection.with_ray_slopes(renderer.splats(camera), renderer.scene, camera)
    assert drawn.ray_slopes is not None
    assert drawn.rgb is not None
    grid = (-(-camera.height // TILE), -(-camera.width // TILE))
    places = torch.stack(tile_centres(drawn.means), dim=1)
    image = drawn.means.new_tensor(background).expand(grid[0] * grid[1], TILE * TILE, 3).clone()
    done = 0
    for bins in bands(drawn, grid, EAGER):
        left = torch.argsort(bins.counts, descending=True)[: int((bins.counts > 0).sum())]
        while len(left):
            longest = int(bins.counts[left[0]])
            tiles, left = left.tensor_split([max(1, VALUES_AT_ONCE // (longest * TILE * TILE))])
            k = torch.arange(longest)
            there = k < bins.counts[tiles, None]
            ids = bins.splats[(bins.first[tiles, None] + k).clamp(max=len(bins.splats) - 1)].long()
            offsets = bins.origins[tiles, None, None] + places - drawn.means[ids][:, :, None]
            alpha = torch.where(there[..., None], alphas(drawn, ids, offsets), 0.0)
            ids = ids[..., None].expand_as(alpha)
            depths = drawn.depths[ids] + share * (drawn.ray_slopes[ids[..., 0]][:, :, None] * offsets).sum(dim=3)
            alpha, ids = sorted_again(alpha, ids, depths, longest if kind == "pixel" else WINDOW)
            light = torch.cumprod(1 - alpha, dim=1)
            weights = alpha * torch.cat([torch.ones_like(light[:, :1]), light[:, :-1]], dim=1)
            weights = torch.where(light >= RULES_3DGS.min_transmittance, weights, 0.0)
            colours = torch.stack([(weights * channel[ids]).sum(dim=1) for channel in drawn.rgb.T], dim=2)
            image[tiles + done] = colours + (1 - weights.sum(dim=1))[..., None] * image.new_tensor(background)
        done += len(bins.counts)
    whole = image.unflatten(1, (TILE, TILE)).unflatten(0, grid).transpose(1, 2).flatten(2, 3).flatten(0, 1)
    return whole[: camera.height, : camera.width]


def alphas(splats: Splats2D, ids: Tensor, offsets: Float[Tensor, "t k P 2"]) -> Float[Tensor, "t k P"]:
    """3DGS's alpha of each splat at offsets from its centre, in px."""
    xx, xy, yy = splats.covs[ids].unbind(dim=2)
    dx, dy = offsets.unbind(dim=3)
    form = yy[..., None] * dx * dx - 2 * xy[..., None] * dx * dy + xx[..., None] * dy * dy
    alpha = splats.opacities[ids][..., None] * torch.exp(-0.5 * form / splats.dets[ids][..., None])
    return torch.where(alpha >= RULES_3DGS.min_alpha, alpha.clamp(max=RULES_3DGS.max_alpha), 0.0)


def sorted_again(alpha: Tensor, ids: Tensor, depths: Tensor, window: int) -> tuple[Tensor, Tensor]:
    """Alphas and splats of each pixel, those that it sees first, sorted in runs of `window`, then of shifted runs."""
    depths = torch.where(alpha > 0, depths, torch.inf)
    seen = (alpha == 0).byte().argsort(dim=1, stable=True)
    alpha, ids, depths = (x.gather(1, seen) for x in (alpha, ids, depths))
    for shift in (0, window // 2):
        cuts = list(range(shift or window, depths.shape[1], window))
        orders = [part.argsort(dim=1, stable=True) for part in depths.tensor_split(cuts, dim=1)]
        starts = [0, *cuts]
        order = torch.cat([part + start for part, start in zip(orders, starts, strict=True)], dim=1)
        alpha, ids, depths = (x.gather(1, order) for x in (alpha, ids, depths))
    return alpha, ids
