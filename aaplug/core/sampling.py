"""Sampling rates: how finely cameras sample each Gaussian, from which rate-aware filters start.

n: Gaussians, v: cameras, c: Gaussians of a chunk.  A camera of focal length f px samples a Gaussian at depth z (along
the optical axis) with f / z pixels per world unit.  It sees the Gaussian when the depth is above `NEAR` and the
projected centre lies in the image widened by `IMAGE_MARGIN` of its size on every side (Mip-Splatting, arXiv 2311.16493,
section 5.1 and its published constants).  Each rate pairs a camera's own focal length with its own depth, as in the
paper's equation 7.  Functions that take cameras raise UsageError if there are none.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.chunks import curve
from aaplug.core.conventions import MIN_SEEN_SHARE
from aaplug.core.lenses import PINHOLE
from aaplug.core.rules import NEAR
from aaplug.core.sights import sights
from aaplug.system.cores import on_free_cores
from aaplug.system.errors import FrameError, UsageError, counted

IMAGE_MARGIN = 0.15  # of the image's side; equals 3DGS's clamp of the Jacobian at 1.3 tan(fov/2)
CHUNK_PAIRS = 4_000_000  # Gaussian-camera pairs held at once: about 150 MB
BOX, BOXES = 1024, 256  # Gaussians in a box that is tried against each camera first; boxes that are made at once
BOX_TOLERANCE = 1e-5  # relative; above the rounding of float32 in the rates
FRAME_SAMPLE_SIZE = 50_000  # Gaussians of the even sample for the frame check


@dataclass(frozen=True, eq=False)
class SamplingBounds:
    """The facts about a camera set that filters use; all are zero for a Gaussian that no camera sees.

    highest, lowest: sampling rate over the cameras that see the Gaussian, in px per world unit.
    nearest: smallest focal length over rate in these cameras: of pinholes the smallest depth, in world units.
    views: number of cameras that see it.
    """

    highest: Float[Tensor, " n"]
    lowest: Float[Tensor, " n"]
    nearest: Float[Tensor, " n"]
    views: Int[Tensor, " n"]

    def __getitem__(self, index: Tensor | slice) -> "SamplingBounds":
        """The bounds of the Gaussians at `index` (a mask, a vector of indices from 0, or a slice)."""
        if isinstance(index, Tensor) and index.dtype != torch.bool:  # several times faster than [index]
            return SamplingBounds(*(column.index_select(0, index) for column in vars(self).values()))
        return SamplingBounds(*(column[index] for column in vars(self).values()))

    def over(self, other: "SamplingBounds") -> "SamplingBounds":
        """The bounds of the same Gaussians over these cameras and others, or over two frames of a scene in time."""
        lowest, nearest = (
            torch.where(self.seen & other.seen, torch.minimum(a, b), torch.maximum(a, b))
            for a, b in ((self.lowest, other.lowest), (self.nearest, other.nearest))
        )
        return SamplingBounds(torch.maximum(self.highest, other.highest), lowest, nearest, self.views + other.views)

    @property
    def seen(self) -> Bool[Tensor, " n"]:
        """True where any camera sees the Gaussian."""
        return self.views > 0

    @property
    def highest_or_coarsest(self) -> Float[Tensor, " n"]:
        """Highest rates; a Gaussian that no camera sees gets the lowest of all highest rates (Mip-Splatting's code).

        Raises:
            FrameError: no camera sees any Gaussian.
        """
        if not len(self.views):
            return self.highest
        if not self.seen.any():
            raise FrameError("sampling bounds", "no camera sees any Gaussian: there is no rate to filter by")
        return torch.where(self.seen, self.highest, self.highest[self.seen].min())


@torch.no_grad()
@on_free_cores()
def sampling_bounds(means: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> SamplingBounds:
    """Lowest and highest sampling rate of each Gaussian over the cameras that see it (highest: Mip-Splatting, eq. 7).

    Memory beyond the result is bounded by `CHUNK_PAIRS`.
    """
    highest, lowest, nearest = (means.new_zeros(len(means)) for _ in range(3))
    focals = means.new_tensor([camera.focal for camera in cameras])
    views = torch.zeros(len(means), dtype=torch.int32, device=means.device)
    for part, near, rates in rates_in_chunks(means, cameras):
        visible = rates > 0
        views[part] = visible.sum(dim=1, dtype=torch.int32)
        highest[part] = rates.amax(dim=1)
        nearest[part] = focals[0] / highest[part]
        if (focals != focals[0]).any():
            nearest[part] = (focals[near] / rates).amin(dim=1)
        lowest[part] = rates.masked_fill_(~visible, torch.inf).amin(dim=1)
    lowest[views == 0] = nearest[views == 0] = 0
    return SamplingBounds(highest, lowest, nearest, views)


@on_free_cores()
def median_rates(means: Float[Tensor, "n 3"], cameras: Sequence[Camera]) -> Float[Tensor, " n"]:
    """Median sampling rate of each Gaussian over the cameras that see it, in px per world unit; 0 if none does."""
    median = means.new_zeros(len(means))
    for part, _, rates in rates_in_chunks(means, cameras):
        median[part] = rates.masked_fill_(rates == 0, torch.nan).nanmedian(dim=1).values.nan_to_num(0.0)
    return median


def check_frame(
    means: Float[Tensor, "n 3"], cameras: Sequence[Camera], scene_name: str, min_share: float = MIN_SEEN_SHARE
) -> float:
    """Share of Gaussians that any camera sees, on an even sample of the scene.

    Raises:
        FrameError: see `check_seen`.
    """
    sample = means[:: max(1, len(means) // FRAME_SAMPLE_SIZE)]
    return check_seen(sampling_bounds(sample, cameras).seen, len(cameras), scene_name, min_share)


def check_seen(seen: Bool[Tensor, " n"], cameras: int, scene_name: str, min_share: float) -> float:
    """Share of Gaussians that any camera sees; 1 if there are none.  cameras: their number.

    Raises:
        FrameError: the share is below `min_share`: scene and cameras are probably in different frames.
    """
    share = seen.double().mean().item() if len(seen) else 1.0
    if share < min_share:
        raise FrameError(
            scene_name,
            f"only {share:.1%} of its Gaussians are seen by any of {counted(cameras, 'camera')} (expected at least "
            f"{min_share:.0%}): scene and cameras are in different frames, or the scene is too small for 3DGS, which "
            f"draws nothing nearer than {NEAR:g} units. nerfstudio scenes need the transform of "
            "dataparser_transforms.json, gsplat scenes were normalised unless trained with normalize_world_space "
            "off; if the cameras are right nevertheless, lower `min_seen`",
        )
    return share


def rates_in_chunks(
    means: Float[Tensor, "n 3"], cameras: Sequence[Camera]
) -> Iterator[tuple[slice | Int[Tensor, " c"], Int[Tensor, " w"], Float[Tensor, "c w"]]]:
    """Yield (a chunk of the Gaussians, cameras, its rates in these); a rate of 0 means "not seen".

    Each Gaussian is in one chunk, or in none if no camera sees it.  Cameras that see nothing of a chunk may be absent.
    The cameras' mean position is subtracted in float64 first, so that scenes far from the origin keep their digits.
    """
    origin = mean_position(cameras)
    poses = torch.stack([camera.cam_from_world for camera in cameras])
    offset = poses[:, :3, 3] + poses[:, :3, :3] @ origin
    rotation, offset, origin = poses[:, :3, :3].to(means), offset.to(means), origin.to(means.device)
    intrinsics = [[c.fx, c.fy, c.cx, c.cy, c.width, c.height, c.focal] for c in cameras]
    intrinsics = means.new_tensor(intrinsics)
    lenses = {i: camera for i, camera in enumerate(cameras) if camera.lens != PINHOLE}
    most, near = max(1, CHUNK_PAIRS // len(cameras)), torch.arange(len(cameras), device=means.device)
    planes = None if lenses or len(means) <= most else _planes(rotation, offset, intrinsics)
    for part in _chunks(means, most, boxed=planes is not None):
        local = (means[part].double() - origin).to(means)
        if planes is not None:
            near = _may_see(planes, offset, local).nonzero()[:, 0]
        if not len(near):
            continue
        fx, fy, cx, cy, width, height, focal = intrinsics[near].T
        x, y, z = (torch.addmm(offset[near, i], local, rotation[near, i].T) for i in range(3))
        visible = (z > NEAR) & _inside(x.div_(z).mul_(fx).add_(cx), width)
        visible &= _inside(y.div_(z).mul_(fy).add_(cy), height)
        rates = torch.where(visible, focal / z, 0.0)
        for i, camera in lenses.items():
            places, depths, sampled, _ = sights(means[part], camera)
            inside = _inside(places, places.new_tensor([camera.width, camera.height])).all(dim=1)
            rates[:, i] = torch.where((depths > NEAR) & inside, sampled, 0.0)
        yield part, near, rates


def _chunks(means: Float[Tensor, "n 3"], most: int, boxed: bool) -> Iterator[slice | Int[Tensor, " c"]]:
    """Chunks of at most so many; boxed: of Gaussians that lie near each other, so that few cameras see any of them."""
    if not boxed:
        yield from (slice(start, start + most) for start in range(0, len(means), most))
        return
    for some in torch.arange(len(means), device=means.device).split(BOX * BOXES):
        places = means[some] - means[some].median(dim=0).values
        usual = places.norm(dim=1).median().clamp(min=torch.finfo(means.dtype).tiny)
        yield from some[curve(places / (usual + places.abs())).argsort()].split(min(BOX, most))


def _planes(
    rotation: Float[Tensor, "v 3 3"], offset: Float[Tensor, "v 3"], intrinsics: Float[Tensor, "v 7"]
) -> Float[Tensor, "v 5 4"]:
    """Sides of what each camera sees as a pinhole: unit normals that point inwards, and the origin's distances."""
    fx, fy, cx, cy, width, height, _ = intrinsics.T
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    sides = [
        [zero, zero, one],
        [fx, zero, cx + IMAGE_MARGIN * width],
        [-fx, zero, width + IMAGE_MARGIN * width - cx],
        [zero, fy, cy + IMAGE_MARGIN * height],
        [zero, -fy, height + IMAGE_MARGIN * height - cy],
    ]
    normals = torch.nn.functional.normalize(torch.stack([torch.stack(side, dim=1) for side in sides], dim=1), dim=2)
    return normals @ torch.cat([rotation, offset[:, :, None]], dim=2)


def _may_see(
    planes: Float[Tensor, "v 5 4"], offset: Float[Tensor, "v 3"], places: Float[Tensor, "c 3"]
) -> Bool[Tensor, " v"]:
    """False for a camera if the box around the places lies outside of one of its planes."""
    low, high = places.aminmax(dim=0)
    normals, distances = planes[..., :3], planes[..., 3]
    inmost = (normals * torch.where(normals > 0, high, low)).sum(dim=2) + distances  # of the box's corners
    size = torch.maximum(low.abs(), high.abs()).norm() + offset.norm(dim=1, keepdim=True)
    return ~(inmost < -BOX_TOLERANCE * size).any(dim=1)


def mean_position(cameras: Sequence[Camera]) -> Float[Tensor, " 3"]:
    """The cameras' mean position."""
    if not cameras:
        raise UsageError("cameras", "there are none, and sampling bounds need at least one")
    return torch.stack([camera.centre for camera in cameras]).mean(dim=0)


def _inside(position: Float[Tensor, "c v"], side: Float[Tensor, " v"]) -> Bool[Tensor, "c v"]:
    return (position >= -IMAGE_MARGIN * side) & (position <= side + IMAGE_MARGIN * side)
