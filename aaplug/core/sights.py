"""Points as a camera sees them through a lens: places, rates of sampling, and the planes of their splats.

n: points.  Through a flat lens a splat is a Gaussian in the pinhole's image plane, as in training.  Through others it
is one in the plane across the ray to its centre, where linearising the projection is best (Huang et al. 2024, "On the
Error Analysis of 3D Gaussian Splatting and an Optimal Projection Strategy").  A pixel of that plane has the area of the
image's own pixel there, so a variance in px² is an angle's.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.rules import NEAR


class Sights(NamedTuple):
    """Points as a camera sees them.

    places: in px.  depths: of a flat lens along the optical axis, else distances, in world units.
    rates: px per world unit.  planes: see `Splats2D.planes`.
    """

    places: Float[Tensor, "n 2"]
    depths: Float[Tensor, " n"]
    rates: Float[Tensor, " n"]
    planes: Float[Tensor, "n 3 3"]


def sights(points: Float[Tensor, "n 3"], camera: Camera, near: float = NEAR) -> Sights:
    """World points through a camera's lens.  What is nearer than `near` gets values of that distance."""
    lens, rotation = camera.lens, camera.cam_from_world[:3, :3].to(points)
    local = (points.double() - camera.centre.to(points.device)).to(points) @ rotation.T
    one = torch.ones_like(local[:, 0])
    if lens.flat:
        depths = local[:, 2]
        ahead = depths.clamp(min=near) if lens.projection == "pinhole" else one
        axes = torch.eye(3).to(local)
        rays = torch.cat([local[:, :2] / ahead[:, None], one[:, None]], dim=1)
        focals = (camera.fx, camera.fy)
        planes = [focal * (axes[i] - rays[:, i, None] * axes[2]) for i, focal in enumerate(focals)]
        planes = torch.stack([*planes, axes[2].expand_as(rays)], dim=1)
        return Sights(camera.pixels(lens.places(rays)), depths, camera.focal / ahead, planes)
    depths = torch.linalg.vector_norm(local, dim=1)
    ahead = depths.clamp(min=near)
    rays = local / ahead[:, None]
    right, down = across(rays)
    focal = camera.focal * lens.areas(rays).sqrt()  # px per radian
    planes = torch.stack([focal[:, None] * right, focal[:, None] * down, rays], dim=1)
    return Sights(camera.pixels(lens.places(rays)), depths, focal / ahead, planes)


def plane_rays(planes: Float[Tensor, "m 3 3"]) -> tuple[Float[Tensor, "m 3 2"], Float[Tensor, "m 3"]]:
    """A ray's change with each px along the axes of `Splats2D.planes`, and the rays of their middles."""
    right, down, ahead = planes.unbind(dim=1)
    columns = [torch.linalg.cross(*pair) for pair in ((down, ahead), (ahead, right), (right, down))]
    by_x, by_y, middle = (column / (columns[2] * ahead).sum(dim=1, keepdim=True) for column in columns)
    return torch.stack([by_x, by_y], dim=2), middle


def across(rays: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
    """Two unit vectors across each unit ray and each other (Duff et al. 2017, "Building an Orthonormal Basis")."""
    x, y, z = rays.unbind(dim=1)
    sign = torch.copysign(torch.ones_like(z), z)
    a = -1 / (sign + z)
    b = x * y * a
    right = torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=1)
    return right, torch.stack([b, sign + y * y * a, -y], dim=1)
