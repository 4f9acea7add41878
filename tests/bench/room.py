"""A room of small textured Gaussians, to look around in; made, not read."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from aaplug import SH_C0, Camera, CameraSet, look_at
from aaplug.core.gaussians import Gaussians, joined

SIDE = 6.0  # world units, of the cubic room around the origin
FLATNESS = 0.1  # thickness of a Gaussian against its width
FOCAL = 652.0  # px: that of a panorama of 4096 px at its horizon
VIEWS = 12
PALE = 0.3  # colour of the furnished room's walls against those of the bare one


def room(per_side: int = 300) -> Gaussians:
    """Six walls of `per_side`² Gaussians each, half a step wide, with waves of colour on each.

    Neighbours are alike: their order, by depth in a pinhole and by distance in a panorama, is not what is tested.
    """
    step = SIDE / per_side
    line = (torch.arange(per_side, dtype=torch.float64) + 0.5) * step - SIDE / 2
    a, b = (x.flatten() for x in torch.meshgrid(line, line, indexing="ij"))
    means, scales, colours = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            others = [i for i in range(3) if i != axis]
            place = torch.empty(len(a), 3, dtype=torch.float64)
            place[:, axis], place[:, others[0]], place[:, others[1]] = sign * SIDE / 2, a, b
            size = torch.full((len(a), 3), 0.5 * step, dtype=torch.float64)
            size[:, axis] *= FLATNESS
            waves = [(f * a + g * b + axis + sign).sin() for f, g in ((4, 1), (1, 3), (2, -2))]
            colours.append(0.5 + 0.4 * torch.stack(waves, dim=1))
            means.append(place)
            scales.append(size)
    count = 6 * len(a)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=torch.cat(means).float(),
        quats=quats,
        log_scales=torch.cat(scales).log().float(),
        logit_opacities=torch.full((count,), 4.0),
        sh=((torch.cat(colours) - 0.5) / SH_C0).float()[:, None],
    )


def inside(focal: float = FOCAL) -> CameraSet:
    """Training views from near the middle of the room, all around."""
    views = []
    for i in range(VIEWS):
        angle, height = 2 * math.pi * i / VIEWS, (-0.5, 0.0, 0.5)[i % 3]
        eye = torch.tensor([0.05 * SIDE * math.cos(angle), 0.05 * SIDE * math.sin(angle), 0.0], dtype=torch.float64)
        ahead = torch.tensor([math.cos(angle), math.sin(angle), height], dtype=torch.float64)
        pose = look_at(eye, eye + ahead, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
        size = round(2 * focal)
        views.append(Camera(f"view_{i}", size, size, focal, focal, size / 2, size / 2, pose).as_trained())
    return CameraSet(tuple(views), tuple(views))


def matrices(pose: Float[Tensor, "4 4"]) -> list[Float[Tensor, "4 4"]]:
    """The poses of the six views of a cube around a camera: ahead, right, behind, left, up and down."""
    return [turned(pose, *angles) for angles in ((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))]


def turned(pose: Float[Tensor, "4 4"], right: float, up: float = 0.0) -> Float[Tensor, "4 4"]:
    """The pose, turned by so many degrees."""
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.from_numpy(Rotation.from_euler("yx", (-right, -up), degrees=True).as_matrix())
    return turn @ pose


def furnished(chair: Gaussians) -> Gaussians:
    """The room with the bundled chair on its floor."""
    walls = room(200)
    colour = torch.cat([walls.sh, walls.sh.new_zeros(len(walls), chair.sh.shape[1] - 1, 3)], dim=1)
    drop = chair.means.new_tensor([0.0, 0.0, -SIDE / 2 - float(chair.means[:, 2].quantile(0.001))])
    chair = replace(chair, means=chair.means + drop, origin=None, extras={})
    return joined([chair, replace(walls, sh=PALE * colour)])
