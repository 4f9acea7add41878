"""Free cameras between those of a data set."""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import Camera

NEIGHBOURS = 6  # cameras nearest to each, of which one is the other end
WAY = 0.2, 0.8  # least and largest share of the way to it


def free_views(cameras: Sequence[Camera], each: int, seed: int = 0) -> list[Camera]:
    """Views between each camera and `each` of its neighbours, at random; none for a single camera.

    They keep the first camera's lens and are no poses of the data set.
    """
    centres = torch.stack([camera.centre for camera in cameras])
    nearest = torch.cdist(centres, centres).argsort(dim=1, stable=True)[:, 1 : NEIGHBOURS + 1]
    draw = torch.Generator().manual_seed(seed)
    found = []
    for camera, others in zip(cameras, nearest, strict=True):
        for number in range(each if len(others) else 0):
            other = cameras[int(others[torch.randint(len(others), (), generator=draw)])]
            share = WAY[0] + (WAY[1] - WAY[0]) * float(torch.rand((), generator=draw))
            found.append(replace(between(camera, other, share), name=f"{camera.name} free {number + 1}"))
    return found


def between(first: Camera, last: Camera, share: float) -> Camera:
    """A free camera on the way from one camera to another: the centre on a line, the rotation about one axis."""
    turn = first.cam_from_world[:3, :3] @ last.cam_from_world[:3, :3].T  # from the last camera's frame to the first's
    rotation = _part(turn.T, share) @ first.cam_from_world[:3, :3]
    centre = first.centre.lerp(last.centre, share)
    pose = torch.eye(4, dtype=first.cam_from_world.dtype)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return replace(first, cam_from_world=pose, trained_focal=None, photo=None)


def _part(rotation: Float[Tensor, "3 3"], share: float) -> Float[Tensor, "3 3"]:
    """A share of a rotation: exp(share · ln R) (Rodrigues)."""
    skew = (rotation - rotation.T) / 2
    sine = float(torch.stack([skew[2, 1], skew[0, 2], skew[1, 0]]).norm())
    angle = math.atan2(sine, (float(rotation.trace()) - 1) / 2)
    if sine == 0:
        return torch.eye(3, dtype=rotation.dtype)
    return torch.linalg.matrix_exp(skew * (share * angle / sine))
