"""Wires in front of a checkerboard, and how much of their contrast a renderer keeps.

A wire is a chain of long Gaussians.  Its width is that of an opaque bar with the same alpha across it.  A wire thinner
than training's dilation is transparent instead, as training makes it.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug import COLOUR_OFFSET, SH_C0, Camera, CameraSet, Renderer, look_at
from aaplug.core.conventions import CLASSIC
from aaplug.core.gaussians import Gaussians, joined
from aaplug.core.imaging import box_average

WIDTHS = (0.5, 1.0, 2.0, 3.0, 4.0)  # px
CELL = 8  # px, of the checkerboard
SPACING = 2.0  # px, between the Gaussians of the board, and between those of a wire
DISTANCE = 4.0  # from the cameras to the board, in world units
WIRE_DISTANCE = 0.995 * DISTANCE  # about a px in front of it
OPACITY = 0.95
THICKNESS = 0.05  # px, of the board and the thinnest wires
GREYS = (0.35, 0.75)
WIRE_COLOUR = (0.9, 0.1, 0.1)
TRAIN_VIEWS, TEST_VIEWS = 12, 3
TURN = 0.15  # largest part of the distance that a camera is off the board's middle, either way


def wires_over_checkerboard(
    widths: Sequence[float] = WIDTHS, side: int = 128, seed: int = 0
) -> tuple[Gaussians, CameraSet]:
    """The scene, and cameras of `side` px that look at its middle."""
    generator = torch.Generator().manual_seed(seed)
    focal = 2.0 * side
    places = torch.arange(-0.8 * side, 0.8 * side, SPACING)
    x, y = (grid.flatten() for grid in torch.meshgrid(places, places, indexing="xy"))
    greys = torch.tensor(GREYS)[((x / CELL).floor() + (y / CELL).floor()).remainder(2).long()]
    x, y = (v + 0.3 * SPACING * torch.rand(len(v), generator=generator) for v in (x, y))
    sizes = torch.tensor([0.6 * SPACING, 0.6 * SPACING, THICKNESS]).expand(len(x), 3)
    board = _gaussians(x, y, sizes, 0.0, OPACITY, greys[:, None].expand(-1, 3), DISTANCE, focal)
    parts = [board]
    for number, width in enumerate(widths):
        along = torch.arange(-0.6 * side, 0.6 * side, SPACING)
        across = (number + 0.5 - len(widths) / 2) * 0.75 * side / len(widths)
        angle = 0.35 * math.pi + 0.1 * float(torch.rand((), generator=generator))
        x = along * math.cos(angle) - across * math.sin(angle)
        y = along * math.sin(angle) + across * math.cos(angle)
        seen = max(CLASSIC.kernel + THICKNESS**2, (width / OPACITY) ** 2 / math.tau)  # px², across the wire
        thin = math.sqrt(seen - CLASSIC.kernel)
        sizes = torch.tensor([0.6 * SPACING, thin, thin]).expand(len(x), 3)
        # neighbours in the chain overlap: 1 - (1 - a)^k of k that cover a place
        covering = 0.6 * math.sqrt(math.tau)
        opacity = 1 - (1 - min(0.99, width / math.sqrt(math.tau * seen))) ** (1 / covering)
        colours = torch.tensor(WIRE_COLOUR).expand(len(x), 3)
        parts.append(_gaussians(x, y, sizes, angle, opacity, colours, WIRE_DISTANCE, focal))
    cameras = [_camera(side, focal, generator, f"view {n}") for n in range(TRAIN_VIEWS + TEST_VIEWS)]
    return joined(parts), CameraSet(tuple(cameras[:TRAIN_VIEWS]), tuple(cameras[TRAIN_VIEWS:]))


@torch.no_grad()
def contrast(drawn: Renderer, look: Renderer, views: Sequence[Camera], factor: int) -> float:
    """The wires' contrast in images at 1/factor of the views' size, against that of the scene's box averages: 1 is all.

    The board is grey, so that red less the mean of green and blue is the wires' alone.  The contrast is the slope of a
    regression of what is drawn on the truth.
    """
    pairs = [
        (_redness(drawn(view.scaled(1 / factor)).rgb), _redness(box_average(look(view).rgb, factor))) for view in views
    ]
    found, truth = (torch.cat(column) for column in zip(*pairs, strict=True))
    truth = truth - truth.mean()
    return float((found * truth).sum() / truth.square().sum())


def _redness(rgb: Float[Tensor, "h w 3"]) -> Float[Tensor, " p"]:
    return (rgb[..., 0] - rgb[..., 1:].mean(dim=2)).flatten()


def _gaussians(
    x: Float[Tensor, " n"], y: Float[Tensor, " n"], sizes: Float[Tensor, "n 3"], angle: float, opacity: float,
    colours: Float[Tensor, "n 3"], distance: float, focal: float,
) -> Gaussians:  # fmt: skip
    """Gaussians across the axis z at a distance from the cameras; places and sizes in px there."""
    px = distance / focal
    means = torch.stack([x * px, y * px, torch.full_like(x, DISTANCE - distance)], dim=1)
    turn = torch.tensor([math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)]).expand(len(x), 4).clone()
    logits = torch.full_like(x, opacity).logit()
    return Gaussians(means, turn, (sizes * px).log(), logits, ((colours - COLOUR_OFFSET) / SH_C0)[:, None].clone())


def _camera(side: int, focal: float, generator: torch.Generator, name: str) -> Camera:
    off = TURN * DISTANCE * (2 * torch.rand(2, generator=generator).double() - 1)
    eye = torch.tensor([*off, DISTANCE]).double()
    pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return Camera(name, side, side, focal, focal, side / 2, side / 2, pose)
