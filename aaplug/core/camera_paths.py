"""Cameras made of other cameras: paths that show aliasing, and free views between those of a data set.

t runs over [0, 1).  Zoom and dolly go from `start` to `end` and back; both are factors on the sampling rate.  Speed is
even in octaves and eases at both ends.  An orbit goes once around.  All three are loops, and keep what the middle of
the image shows there, wherever the principal point is.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera, CameraSet, numbered, rigid_motion
from aaplug.core.lenses import ORTHO
from aaplug.core.rules import NEAR
from aaplug.system.errors import UsageError

NEIGHBOURS = 6  # cameras nearest to each, between which and itself its free views lie
LEAST_SHARE, LARGEST_SHARE = 0.2, 0.8  # of the way to the neighbour


def zoomed(view: Camera, by: float) -> Camera:
    """The view with its focal length multiplied, about the middle of the image; pose and size stay."""
    x, y = view.width / 2, view.height / 2
    return replace(view, fx=view.fx * by, fy=view.fy * by, cx=x + by * (view.cx - x), cy=y + by * (view.cy - y))


def moved(view: Camera, by: float, depth: float) -> Camera:
    """A free camera, moved along the ray of the image's middle: from a point at `depth` (world units) to depth / by."""
    pose = view.cam_from_world.clone()
    pose[:3, 3] += depth * (1 / by - 1) * _ahead(view)
    return replace(view, cam_from_world=pose, trained_focal=None)


def factor(t: float, start: float, end: float) -> float:
    """The factor on the sampling rate that a zoom or dolly has at t."""
    progress = 0.5 - 0.5 * math.cos(2 * math.pi * t)
    return start * (end / start) ** progress


def orbit(view: Camera, t: float, depth: float, up: Float[Tensor, " 3"]) -> Camera:
    """The view turned about the axis `up` through what the image's middle shows at a depth, as a free camera.

    depth: in world units.  up: of length 1.
    """
    from scipy.spatial.transform import Rotation  # takes a third of a second to import

    pivot = view.centre + depth * _ahead(view) @ view.cam_from_world[:3, :3]
    turn = torch.from_numpy(Rotation.from_rotvec(2 * math.pi * t * up.double().numpy()).as_matrix())
    pose = view.cam_from_world @ rigid_motion(turn, pivot - turn @ pivot)
    return replace(view, cam_from_world=pose, trained_focal=None)


def _ahead(view: Camera) -> Float[Tensor, " 3"]:
    """The ray of the image's middle in the camera's frame, where z is 1; the axis, if that ray does not lead ahead."""
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    ray = axis if view.lens == ORTHO else view.rays(axis.new_tensor([view.width / 2, view.height / 2]))
    return ray / ray[2] if ray[2] > 0 else axis


def median_depth(means: Float[Tensor, "n 3"], view: Camera) -> float:
    """Median depth of the Gaussians that project into the view, in world units; raises UsageError if none does."""
    pixels, depth = view.project(means)
    x, y = pixels.unbind(dim=1)
    inside = (depth > NEAR) & (x >= 0) & (x <= view.width) & (y >= 0) & (y <= view.height)
    if not bool(inside.any()):
        raise UsageError(view.name, "sees no Gaussian, so there is no distance to change")
    return float(torch.median(depth[inside]))


def up_of(cameras: CameraSet) -> Float[Tensor, " 3"]:
    """Mean up direction of the training images."""
    up = -torch.stack([camera.cam_from_world[1, :3] for camera in cameras.train]).mean(dim=0)
    return torch.nn.functional.normalize(up, dim=0)


def frames(path: Callable[[float], Camera], count: int) -> list[Camera]:
    """`count` cameras along a path, named by their number."""
    return [replace(path(i / count), name=name) for i, name in enumerate(numbered(count))]


def free_views(cameras: Sequence[Camera], each: int, seed: int = 0) -> list[Camera]:
    """Views between each camera and `each` of its neighbours, at random; none for a single camera.

    They keep the first camera's lens and are no poses of the data set.
    """
    centres = torch.stack([camera.centre for camera in cameras])
    nearest = torch.cdist(centres, centres).argsort(dim=1, stable=True)[:, 1 : NEIGHBOURS + 1]
    generator = torch.Generator().manual_seed(seed)
    views = []
    for camera, others in zip(cameras, nearest, strict=True):
        for number in range(each if len(others) else 0):
            other = cameras[int(others[torch.randint(len(others), (), generator=generator)])]
            share = LEAST_SHARE + (LARGEST_SHARE - LEAST_SHARE) * float(torch.rand((), generator=generator))
            views.append(replace(between(camera, other, share), name=f"{camera.name} free {number + 1}"))
    return views


def between(first: Camera, last: Camera, share: float) -> Camera:
    """A free camera on the way from one camera to another: the centre on a line, the rotation about one axis."""
    from scipy.spatial.transform import Rotation

    turn = last.cam_from_world[:3, :3] @ first.cam_from_world[:3, :3].T  # from the first camera's frame to the last's
    part = Rotation.from_rotvec(share * Rotation.from_matrix(turn.numpy()).as_rotvec())
    rotation = torch.from_numpy(part.as_matrix()) @ first.cam_from_world[:3, :3]
    pose = rigid_motion(rotation, -rotation @ first.centre.lerp(last.centre, share))
    return replace(first, cam_from_world=pose, trained_focal=None, photo=None)


def toward(first: Camera, last: Camera, share: float) -> Camera:
    """As `between`, with the lens on its way too: focal lengths even in octaves, the principal point on a line."""
    fx, fy = (a * (b / a) ** share for a, b in ((first.fx, last.fx), (first.fy, last.fy)))
    cx, cy = (a + share * (b - a) for a, b in ((first.cx, last.cx), (first.cy, last.cy)))
    return replace(between(first, last, share), fx=fx, fy=fy, cx=cx, cy=cy)
