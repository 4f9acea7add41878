"""Scenes, cameras and splats at random to try laws on."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

import torch
from torch import Tensor
from torch.autograd.gradcheck import GradcheckError

from aaplug.core.cameras import Camera, centred, look_at
from aaplug.core.gaussians import Gaussians
from aaplug.core.splats import Splats2D

F64 = torch.float64
T = TypeVar("T", Splats2D, Gaussians)


def require(holds: object, problem: str) -> None:
    """Raise AssertionError with the problem unless the condition holds."""
    if not holds:
        raise AssertionError(problem)


def copies_of(thing: Splats2D | Gaussians) -> dict[str, Tensor]:
    """Copies of all tensors, by name."""
    return {name: value.clone() for name, value in vars(thing).items() if isinstance(value, Tensor)}


def require_same(thing: Splats2D | Gaussians, before: dict[str, Tensor], problem: str = "changes") -> None:
    """Raise AssertionError, with a problem of a column, unless these tensors are as they were, to the bit."""
    for name, value in before.items():
        require(getattr(thing, name).equal(value), f"{problem} {name}")


def require_gradients(change: Callable[[T], T], thing: T, inputs: Sequence[str], of: Sequence[str]) -> None:
    """Raise AssertionError unless autograd's gradient of these columns of a changed thing is that of small differences.

    inputs: the columns of the thing by which it is taken.
    """

    def outputs(*values: Tensor) -> tuple[Tensor, ...]:
        found = change(replace(thing, **dict(zip(inputs, values, strict=True))))
        attached = sum(0.0 * value.sum() for value in values)  # gradcheck passes by an output that is detached
        return tuple(getattr(found, name) + attached for name in of)

    try:
        torch.autograd.gradcheck(outputs, [getattr(thing, name).clone().requires_grad_() for name in inputs])
    except GradcheckError as error:
        if not (found := re.search(r"output (\d+) with respect to input (\d+)", str(error))):
            raise
        output, by = of[int(found[1])], inputs[int(found[2])]
        problem = f"the gradient of {output} by {by} is not that of small differences"
        raise AssertionError(f"{problem}, or two calls differ") from error


def make_camera(
    eye: tuple[float, float, float] = (0.0, -4.0, 0.0),
    size: tuple[int, int] = (64, 48),
    fov: float = 0.7,
    name: str = "view",
) -> Camera:
    """A pose of the data set that looks at the origin; size is width and height in px."""
    focal = 0.5 * size[0] / math.tan(fov / 2)
    pose = look_at(torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return centred(name, size, focal, pose).as_trained()


def make_scene(n: int, seed: int = 0, dtype: torch.dtype = torch.float32, degree: int = 1) -> Gaussians:
    """Random Gaussians around the origin with scales near 0.1 world units."""
    g = torch.Generator().manual_seed(seed)
    rand = {"generator": g, "dtype": F64}
    return Gaussians(
        means=torch.randn(n, 3, **rand) * 0.7,
        quats=torch.randn(n, 4, **rand),
        log_scales=torch.randn(n, 3, **rand) * 0.7 - 2.5,
        logit_opacities=torch.randn(n, **rand) * 2,
        sh=torch.randn(n, (degree + 1) ** 2, 3, **rand) * 0.5,
    ).to(dtype)


def make_splats(m: int, hw: tuple[int, int], seed: int = 0, log_sigmas: tuple[float, float] = (-1.0, 2.0)) -> Splats2D:
    """Random coloured splats in and around an image; log_sigmas: range of ln standard deviations, in px."""
    g = torch.Generator().manual_seed(seed)
    low, high = log_sigmas
    sigmas = torch.exp(low + (high - low) * torch.rand(m, 2, generator=g))
    angle = torch.rand(m, generator=g) * math.pi
    cos, sin = angle.cos(), angle.sin()
    a = torch.stack([cos * sigmas[:, 0], -sin * sigmas[:, 1]], dim=1)
    b = torch.stack([sin * sigmas[:, 0], cos * sigmas[:, 1]], dim=1)
    return Splats2D(
        means=torch.rand(m, 2, generator=g) * 1.2 * torch.tensor([hw[1], hw[0]]) - 0.1 * max(hw),
        covs=torch.stack([(a * a).sum(1), (a * b).sum(1), (b * b).sum(1)], dim=1),
        dets=sigmas.prod(dim=1).square(),
        depths=torch.rand(m, generator=g) * 5 + 1,
        opacities=torch.rand(m, generator=g),
        sources=torch.arange(m),
        rgb=torch.rand(m, 3, generator=g),
    )
