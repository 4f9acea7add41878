"""Splats through a lens: each is evaluated on the ray of a pixel, in its own plane.

The ray d meets a splat's plane (right·d, down·d) / (ahead·d) px from the splat's centre (`Splats2D.planes`).  So only
the projection of the Gaussian is linearised, at its own centre, and the lens is exact at every pixel: a panorama has no
seam, and its poles are like any other place.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from aaplug.core.ellipses import positive_cutoff, squared_cutoff, whitening, whitening_columns
from aaplug.core.interfaces import Limits, Pixels
from aaplug.core.kernels import Kernels
from aaplug.core.lenses import Lens
from aaplug.core.rules import Rules
from aaplug.core.sights import plane_rays
from aaplug.core.splats import Splats2D, concatenated
from aaplug.methods.pixel_kernels.point import HALF_LOG2_E, LOG2_PADDING, exp2_of
from aaplug.methods.pixel_kernels.raster_rows import COLUMNS, OPACITY, TILE

CORNERS = 12  # of the polygon around a splat's cut-off ellipse
MIN_AHEAD = 1e-6  # lower bound of ahead·d: behind the plane no splat is seen
MAX_GROWTH = 1.3  # of the affine map's ellipse until it holds the corners; beyond it, a box bounds the splat
CACHED_IMAGES = 2  # whose rays are kept: views of a data set, and frames, share a lens
SLACK = 1.01  # relative, of an ellipse: for rounding
NEAR_POLE = 0.7  # share of the distance to a pole from which on a splat has the whole width
BOX_MARGIN = 1.2  # for what lies between corners
MAX_RADIUS = 1.0  # radians: beyond it, the whole image bounds the splat


@dataclass(frozen=True)
class Ray:
    """Alpha is opacity times the Gaussian's value where the pixel's ray meets the splat's plane."""

    name: str = "ray"
    columns: int = COLUMNS + 3
    needs_depth_slopes: bool = False
    splats_per_pass: int = 8

    def rays(
        self, splats: Splats2D, x: Float[Tensor, "*n"], y: Float[Tensor, "*n"]
    ) -> tuple[Float[Tensor, "*n"], Float[Tensor, "*n"], Float[Tensor, "*n"]]:
        """Of the splats' camera; x, y and 1 without one."""
        if splats.camera is None:
            return x, y, torch.ones_like(x)
        camera = splats.camera
        if camera.lens.distorts:  # inverting it takes longer than drawing
            columns, rows = (place.long().clamp(0, side - 1) for place, side in ((x, camera.width), (y, camera.height)))
            rays = rays_of_pixels(camera.lens, camera.intrinsics)[rows, columns].to(x)
        else:
            rays = camera.rays(torch.stack([x, y], dim=-1))
        right, down, ahead = rays.unbind(dim=-1)
        return right.contiguous(), down.contiguous(), ahead.contiguous()

    def bounding_ellipses(self, splats: Splats2D, rules: Rules) -> Splats2D | None:
        """Ellipses in the image that contain the splats' cut-off ellipses, bent by the lens.

        They hold the image of a polygon around each cut-off ellipse.  Where the lens bends it little, its best affine
        map gives their axes; else a box does.  A splat at a panorama's pole has its whole width, and a splat wider than
        `MAX_RADIUS` the whole image.
        """
        camera, planes = splats.camera, splats.planes
        if camera is None or planes is None:
            return None
        lens, tiny = camera.lens, torch.finfo(splats.means.dtype).tiny
        cutoff = positive_cutoff(splats, rules.min_alpha)
        angles = torch.arange(CORNERS).to(cutoff) * (2 * math.pi / CORNERS)
        circle = torch.stack([angles.cos(), angles.sin()], dim=1) / math.cos(math.pi / CORNERS)
        xx, xy, _ = splats.covs.unbind(dim=1)
        long = xx.clamp(min=tiny).sqrt()
        x = cutoff.sqrt()[:, None] * long[:, None] * circle[:, 0]
        y = cutoff.sqrt()[:, None] * (
            (xy / long)[:, None] * circle[:, 0] + (splats.dets.sqrt() / long)[:, None] * circle[:, 1]
        )
        (right, _, ahead), (along, middles) = planes.unbind(dim=1), plane_rays(planes)
        by_x, by_y = along[:, None].unbind(dim=3)
        rays = middles[:, None] + x[..., None] * by_x + y[..., None] * by_y
        corners = camera.pixels(lens.places(rays)) - splats.means[:, None]
        turn = camera.fx * lens.period
        if turn:
            corners[..., 0] -= turn * (corners[..., 0] / turn).round()
        middle = corners.mean(dim=1)
        affine = (corners - middle[:, None]).mT @ circle * (2 * math.cos(math.pi / CORNERS) ** 2 / CORNERS)
        area = torch.linalg.det(affine)
        (a, b), (c, d) = (row.unbind(dim=1) for row in affine.unbind(dim=1))
        u, v = (corners - middle[:, None]).unbind(dim=2)
        safe = torch.where(area == 0, 1.0, area)
        growth = torch.hypot(d[:, None] * u - b[:, None] * v, a[:, None] * v - c[:, None] * u).amax(dim=1)
        growth = SLACK * math.cos(math.pi / CORNERS) * growth / safe.abs()
        bends = (growth > MAX_GROWTH) | (area == 0)
        scale = (growth.square() * growth.square() / cutoff)[:, None]  # once more, for what lies between corners
        covs = scale * torch.stack([a * a + b * b, a * c + b * d, c * c + d * d], dim=1)
        dets = scale[:, 0].square() * area.square()
        low, high = corners.amin(dim=1), corners.amax(dim=1)
        centre, half = (low + high) / 2, BOX_MARGIN * (high - low) / 2
        size = half.new_tensor([camera.width, camera.height])
        if not lens.flat:
            sight = ahead / _norm(ahead)
            radius = torch.atan(torch.hypot(x, y).amax(dim=1) / _norm(right)[:, 0])
            if turn:
                to_pole = torch.acos(sight[:, 1].abs().clamp(max=1))
                around, reach = radius >= NEAR_POLE * to_pole, camera.fy * BOX_MARGIN * radius
                whole = torch.stack([torch.full_like(reach, turn), reach], dim=1)
                half = torch.where(around[:, None], whole, half)
                centre = torch.where(around[:, None], 0.0, centre)
                bends = bends | around
            else:  # the whole horizon of a fisheye meets behind it
                radius = torch.where(radius + torch.acos(sight[:, 2].clamp(-1, 1)) >= math.pi, math.pi, radius)
            wide = (radius > MAX_RADIUS)[:, None]
            half, centre = torch.where(wide, size, half), torch.where(wide, size / 2 - splats.means, centre)
            bends = bends | wide[:, 0]
        if turn:  # a splat and its copy beyond the edge may not reach the same tile
            most = turn / 2 - 2 * TILE
            bends = bends | ((cutoff * covs[:, 0]).sqrt() >= most)
            half = torch.stack([torch.where(2**0.5 * half[:, 0] >= most, turn, half[:, 0]), half[:, 1]], dim=1)
        variance = 2 * half.square() / cutoff[:, None]  # an ellipse around the box
        box = torch.stack([variance[:, 0], torch.zeros_like(cutoff), variance[:, 1]], dim=1)
        covs = torch.where(bends[:, None], box, covs)
        dets = torch.where(bends, variance.prod(dim=1), dets)
        return replace(splats, means=splats.means + torch.where(bends[:, None], centre, middle), covs=covs, dets=dets)

    def raster_rows(self, splats: Splats2D, kernels: Kernels) -> Float[Tensor, "m_and_1 c"]:
        """Two forms of the ray, opacity as its log2, colour, and what lies ahead, by which the forms are divided."""
        assert splats.rgb is not None
        right, down, ahead = _planes(splats).unbind(dim=1)
        ux, uy, vx, vy = (HALF_LOG2_E**0.5 * form[:, None] for form in whitening_columns(splats.covs, splats.dets))
        opacity = (splats.opacities.log2() - LOG2_PADDING)[:, None]
        rows = torch.cat([ux * right + uy * down, vx * right + vy * down, opacity, splats.rgb, ahead], dim=1)
        return functional.pad(rows, (0, 0, 0, 1))

    def alpha(self, rows: Float[Tensor, "*n t c"], pixels: Pixels, limits: Limits) -> Float[Tensor, "*n t P"]:
        """2^(log2 o - u² - v²), 0 below the cut-off."""
        assert pixels.z is not None
        along = [
            rows[..., at, None] * pixels.x + rows[..., at + 1, None] * pixels.y + rows[..., at + 2, None] * pixels.z
            for at in (0, 3, rows.shape[-1] - 3)
        ]
        inverse = 1 / along[2].clamp(min=MIN_AHEAD)
        u, v = along[0] * inverse, along[1] * inverse
        return exp2_of(rows[..., OPACITY, None] - u * u - v * v, limits)

    def exact(self, splats: Splats2D, offsets: Float[Tensor, "p m 2"]) -> Float[Tensor, "p m"]:
        """exp(-dᵀ C⁻¹ d / 2) where the pixel's ray meets the splat's plane, at d from its centre."""
        x, y = (offsets + splats.means).unbind(dim=2)
        rays = torch.stack(self.rays(splats, x, y), dim=2)
        right, down, ahead = torch.einsum("mij,pmj->ipm", _planes(splats), rays)
        place = torch.stack([right, down], dim=2) / ahead.clamp(min=MIN_AHEAD)[..., None]
        white = torch.einsum("mij,pmj->pmi", whitening(splats), place)
        seen = (rays.square().sum(dim=2) > 0) & ~splats.are_copies  # which are for the tiles alone
        return torch.exp(-0.5 * white.square().sum(dim=2)) * seen


@lru_cache(CACHED_IMAGES)
def rays_of_pixels(lens: Lens, intrinsics: tuple[float, float, float, float, int, int]) -> Float[Tensor, "h w 3"]:
    """Rays of the centres of an image's pixels, in float64.  intrinsics: see `Camera.intrinsics`."""
    *values, width, height = intrinsics
    y, x = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) + 0.5 for side in (height, width)), indexing="ij")
    fx, fy, cx, cy = values
    return lens.rays(torch.stack([(x - cx) / fx, (y - cy) / fy], dim=-1))


def with_copies(splats: Splats2D, rules: Rules) -> Splats2D:
    """Splats of one view, and copies of those that cross a panorama's edge, a full turn beyond the other edge.

    A splat and its copy reach different tiles.  One so wide that they would not has the whole width, and no copy.
    """
    camera = splats.camera
    if camera is None or not camera.lens.period:
        return splats
    turn = camera.fx * camera.lens.period
    ellipses, parts = splats.bounds(RAY, rules) or RAY.bounding_ellipses(splats, rules), [splats]
    assert ellipses is not None
    cutoff = squared_cutoff(ellipses.opacities, rules.min_alpha).clamp(min=0)
    half = (cutoff * ellipses.covs[:, 0]).sqrt()
    for sign in (-1, 1):
        places = ellipses.means[:, 0] + sign * turn
        reaches = (half < turn / 2) & (places + half > 0) & (places - half < camera.width)
        rows = reaches.nonzero().squeeze(1)
        shift = splats.means.new_tensor([sign * turn, 0.0])
        copies = splats[rows]
        parts.append(copies.with_columns({"means": copies.means + shift}))
    return concatenated(parts)


def _planes(splats: Splats2D) -> Float[Tensor, "m 3 3"]:
    """Planes of the splats; without a camera, of rays that are places: (x, y, 1)."""
    if splats.planes is not None:
        return splats.planes
    x, y = splats.means.unbind(dim=1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    return torch.stack([one, zero, -x, zero, one, -y, zero, zero, one], dim=1).unflatten(1, (3, 3))


def _norm(vectors: Float[Tensor, "m 3"]) -> Float[Tensor, "m 1"]:
    return torch.linalg.vector_norm(vectors, dim=1, keepdim=True)


RAY = Ray()
