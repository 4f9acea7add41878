"""Frames with an aperture and a shutter, as means of frames of moved pinholes.

Each sample of an exposure is one frame (Haeberli and Akeley, "The accumulation buffer", 1990).  One set of samples
covers the pixel, the lens and the time together (Cook, Porter and Carpenter, "Distributed ray tracing", 1984).  A
sample's camera stands at its place in the opening, its principal point moved so that the plane in focus stays.

What follows is aaplug's own.  Each sample stands for a cell of the set, and so its splats are convolved with their path
across that cell: samples that are few overlap instead of showing as ghosts.  A single sample takes the whole path.
`core.light` says how much light a splat has then.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.camera_paths import toward
from aaplug.core.cameras import Aperture, Camera
from aaplug.core.rules import NEAR
from aaplug.core.splats import Splats2D

CELL_SHARE = 0.75  # of a cell's variance, that its splats are convolved with; measured
FAINT = 1 / 32  # opacity: of splats that are fainter once they are spread, some are drawn, with as much
AXIS_WEIGHTS = 0.01, 0.01, 0.1, 0.1, 0.01  # of x and y in the pixel and in the opening, and of time
SHORTEST = 1e-12  # px²: least variance of a path, at which roots have gradients
MAX_SHIFT = 1e6  # px: a splat that moves farther in an exposure looks the same
MAX_TRIED = 256  # lattices of each size
MAX_COMPARED = 256  # points of lattices of two sizes
CLEARLY_LESS = 0.97  # share of a lattice's own P₂ below which one of another size takes its place


def frame_count(camera: Camera) -> int:
    """Number of frames that a view is the mean of: the samples of its exposure, or 1."""
    return 1 if camera.exposure is None else camera.exposure.samples


def sample_cameras(camera: Camera) -> Iterator[Camera]:
    """The camera of each sample of its exposure, which it keeps: `cells` reads it; without one the camera itself."""
    exposure = camera.exposure
    if exposure is None:
        yield camera
        return
    for x, y, u, v, time in lattice(exposure.samples).tolist():
        moved = camera if exposure.motion is None else toward(*exposure.motion, time)
        right, down = (0.0, 0.0) if exposure.aperture is None else opening(exposure.aperture, u, v)
        near = 0.0 if exposure.aperture is None else 1 / exposure.aperture.focus
        pose = moved.cam_from_world.clone()
        pose[:3, 3] -= pose.new_tensor([right, down, 0.0])
        cx, cy = moved.cx + 0.5 - x + moved.fx * right * near, moved.cy + 0.5 - y + moved.fy * down * near
        yield replace(camera, fx=moved.fx, fy=moved.fy, cx=cx, cy=cy, cam_from_world=pose)


def spread_out(
    splats: Splats2D, camera: Camera, light: Float[Tensor, " m"] | None = None
) -> tuple[Splats2D, Float[Tensor, " m"]]:
    """Splats convolved with their path across a sample's cell, less some faint ones; and the opacities of all of them.

    light: factors of opacity for splats that are spread without end, None for 1; see `core.light`.  For one that
        keeps the share r of its height it is light^(1 - r).
    """
    wide = splats.convolved(CELL_SHARE * cells(splats, camera), compensate=True, floor=0.0)
    if light is not None:
        left = (splats.dets / wide.dets).clamp(max=1.0).sqrt()
        wide = wide.with_columns({"opacities": wide.opacities * light ** (1 - left)})
    opacities, tiny = wide.opacities, torch.finfo(wide.opacities.dtype).tiny
    chances = (opacities / splats.opacities.clamp(tiny, FAINT)).detach().clamp(tiny, 1.0)
    turns = chances.double().cumsum(0)  # each whole turn draws one, so that neighbours in the file share the chances
    chosen = ((turns + 0.5).floor() > (turns - chances + 0.5).floor()).nonzero().squeeze(1)
    wide = wide.with_columns({"opacities": opacities / chances})
    return wide.selected(chosen), opacities


def cells(splats: Splats2D, camera: Camera) -> Float[Tensor, "m 3"]:
    """Packed covariance in px² of each splat's path across the cell of one sample.

    N samples that fill an ellipse of covariance Σ evenly have cells of covariance √det Σ / N; along a line, of λ / N².
    """
    assert camera.exposure is not None
    xx, xy, yy = spread(splats, camera).unbind(dim=1)
    middle, half, count = ((xx + yy) / 2).clamp(min=SHORTEST), (xx - yy) / 2, camera.exposure.samples
    radius = torch.hypot(half, xy + torch.finfo(xx.dtype).tiny)
    longer, shorter = middle + radius, (middle - radius).clamp(min=SHORTEST)
    even = (longer * shorter).sqrt() / count
    along, across = torch.maximum(even, longer / count**2), torch.minimum(even, shorter)
    mean, turn = (along + across) / 2, (along - across) / 2 / radius
    return torch.stack([mean + turn * half, turn * xy, mean - turn * half], dim=1)


def spread(splats: Splats2D, camera: Camera) -> Float[Tensor, "m 3"]:
    """Packed covariance in px² of each splat's path while the whole opening and time pass.

    A place r of the opening moves a splat at depth z by f r (1/focus - 1/z) px; of even motion by d px, the covariance
    is d dᵀ / 12.
    """
    exposure = camera.exposure
    assert exposure is not None
    path = splats.covs.new_zeros(len(splats), 3)
    if (aperture := exposure.aperture) is not None:
        scale = (1 / aperture.focus - 1 / splats.depths).square() * aperture.variance
        path += scale[:, None] * path.new_tensor([camera.fx**2, 0.0, camera.fy**2])
    if exposure.motion is not None:
        x, y = (placed(splats, camera, exposure.motion[1]) - placed(splats, camera, exposure.motion[0])).unbind(dim=1)
        path += torch.stack([x * x, x * y, y * y], dim=1) / 12
    return path


def placed(splats: Splats2D, camera: Camera, other: Camera) -> Float[Tensor, "m 2"]:
    """Places in px, seen by another camera, of splats that this one sees; through a lens, in the splats' planes.

    Through a lens that is not flat, a distance from the plane's own centre is the angle, as variances there are.
    """
    lens, planes, depths = camera.lens, splats.planes, splats.depths[:, None]
    parallel = lens.projection == "ortho"
    if planes is None or lens.flat:
        focal, middle = (splats.means.new_tensor(pair) for pair in ((camera.fx, camera.fy), (camera.cx, camera.cy)))
        across = (splats.means - middle if planes is None else -planes[:, :2, 2]) / focal
        local = torch.cat([across if parallel else across * depths, depths], dim=1)
    else:
        local = planes[:, 2] * depths
    turn = other.cam_from_world[:3, :3] @ camera.cam_from_world[:3, :3].T
    shift = other.cam_from_world[:3, 3] - turn @ camera.cam_from_world[:3, 3]
    seen = local @ turn.T.to(local) + shift.to(local)
    if planes is None or lens.flat:
        places = seen[:, :2] if parallel else seen[:, :2] / seen[:, 2:].clamp(min=NEAR)
        return other.pixels(places).clamp(-MAX_SHIFT, MAX_SHIFT)
    if (other.fx, other.fy) != (camera.fx, camera.fy):  # the ray that this camera has there
        rays = camera.rays(other.pixels(lens.places(seen)))
        seen = torch.where(rays.any(dim=1, keepdim=True), rays, seen)
    right, down, ahead = torch.einsum("mij,mj->im", planes, seen)
    rate = torch.linalg.vector_norm(planes[:, 0], dim=1)  # px per radian
    length = (right**2 + down**2 + torch.finfo(seen.dtype).tiny).sqrt()
    return torch.stack([right, down], dim=1) * (rate * torch.atan2(length / rate, ahead) / length)[:, None]


def opening(aperture: Aperture, u: float, v: float) -> tuple[float, float]:
    """Right and down in world units of a place in the opening, from the unit square; areas keep their shares.

    The square goes to the disc by Shirley and Chiu's concentric map (1997); in a polygon, each sector of the disc goes
    to a triangle, where the tangent of the angle is even.
    """
    a, b = 2 * u - 1, 2 * v - 1
    if a == b == 0:
        return 0.0, 0.0
    radius, angle = (a, b / a * math.pi / 4) if abs(a) > abs(b) else (b, math.pi / 2 - a / b * math.pi / 4)
    if aperture.blades:
        half = math.pi / aperture.blades
        angle += math.pi * (radius < 0)
        radius = abs(radius)
        sector, share = divmod(angle / (2 * half), 1.0)
        within = math.atan((2 * share - 1) * math.tan(half))
        radius *= math.cos(half) / math.cos(within)
        angle = (2 * sector + 1) * half + within
    return aperture.radius * radius * math.cos(angle), aperture.radius * radius * math.sin(angle)


@lru_cache(maxsize=16)
def lattice(count: int) -> Float[Tensor, "count 5"]:
    """Points of (0, 1)⁵ of mean 1/2: a rank-1 lattice of Korobov's form (1959), of least weighted P₂.

    Along each axis there is one point in each of `count` equal parts.  P₂ (Sloan and Joe 1994) with a weight for each
    axis (Sloan and Woźniakowski 1998): alike for all, it leaves 17 or 61 points in a few rows of the opening.  Where
    `count` has many divisors, a lattice of one point more, which is left out, is better (Fang and Wang 1994).
    """
    own = _lattice_of(count, count)
    if count > MAX_COMPARED:
        return own
    other = _lattice_of(count + 1, count)
    excess, least = (_excess((points[:, None] - points) % 1) for points in (other, own))
    return other if excess < CLEARLY_LESS * least else own


def _lattice_of(size: int, count: int) -> Float[Tensor, "count 5"]:
    """The last `count` points of the lattice of `size` points that has the least excess, each in its part."""
    index, tried = torch.arange(size)[:, None], [a for a in range(1, max(2, size)) if math.gcd(a, size) == 1]
    powers = [[pow(a, n, size) for n in range(len(AXIS_WEIGHTS))] for a in tried[:: -(-len(tried) // MAX_TRIED)]]
    lattices = (index * torch.tensor(each) % size for each in powers)
    parts = min(lattices, key=lambda parts: _excess(parts.double() / size))
    left = size - count
    return (parts[left:] - left + 0.5).double() / count


def _excess(offsets: Float[Tensor, "*n 5"]) -> float:
    """Weighted P₂ of points with these offsets from each other, modulo 1."""
    terms = torch.tensor(AXIS_WEIGHTS, dtype=torch.float64) * 2 * math.pi**2 * (offsets * (offsets - 1) + 1 / 6)
    return float((1 + terms).prod(dim=-1).mean() - 1)
