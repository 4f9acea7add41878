"""Camera paths that show aliasing: zoom, dolly and orbit from one view of the data set.

t runs over [0, 1).  Zoom and dolly go from `start` to `end` and back; both are factors on the sampling rate.  Speed is
even in octaves and eases at both ends.  An orbit goes once around.  All three are loops.
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet


def zoomed(view: Camera, by: float) -> Camera:
    """The view with its focal length multiplied."""
    return replace(view, fx=view.fx * by, fy=view.fy * by)


def moved(view: Camera, by: float, depth: float) -> Camera:
    """A free camera, moved along the view's axis so that a point at `depth` (world units) is at depth / by."""
    pose = view.cam_from_world.clone()
    pose[2, 3] += depth * (1 / by - 1)
    return replace(view, cam_from_world=pose, trained_focal=None)


def zoom(view: Camera, t: float, start: float, end: float) -> Camera:
    """The view with its focal length multiplied; pose and size stay."""
    return zoomed(view, factor(t, start, end))


def dolly(view: Camera, t: float, start: float, end: float, depth: float) -> Camera:
    """The view from farther away or nearer, as a free camera: see `moved`."""
    return moved(view, factor(t, start, end), depth)


def factor(t: float, start: float, end: float) -> float:
    """The factor on the sampling rate that a zoom or dolly has at t."""
    way = 0.5 - 0.5 * math.cos(2 * math.pi * t)
    return start * (end / start) ** way


def orbit(view: Camera, t: float, depth: float, up: Float[Tensor, " 3"]) -> Camera:
    """The view turned about the axis `up` through the point `depth` world units ahead, as a free camera."""
    pivot = view.centre + depth * view.cam_from_world[2, :3]
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = _rotation(up, 2 * math.pi * t)
    turn[:3, 3] = pivot - turn[:3, :3] @ pivot
    return replace(view, cam_from_world=view.cam_from_world @ turn, trained_focal=None)


def up_of(cameras: CameraSet) -> Float[Tensor, " 3"]:
    """Mean up direction of the training images."""
    up = -torch.stack([camera.cam_from_world[1, :3] for camera in cameras.train]).mean(dim=0)
    return torch.nn.functional.normalize(up, dim=0)


def frames(path: Callable[[float], Camera], count: int) -> list[Camera]:
    """`count` cameras along a path, named by their number."""
    digits = len(str(count - 1))
    return [replace(path(i / count), name=f"{i:0{digits}}") for i in range(count)]


def _rotation(axis: Float[Tensor, " 3"], angle: float) -> Float[Tensor, "3 3"]:
    """Rodrigues' formula, for a unit axis."""
    x, y, z = axis.double().tolist()
    cross = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)
    identity = torch.eye(3, dtype=torch.float64)
    return identity + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
