"""Colour of splats, from the spherical harmonics of their Gaussians.

n: Gaussians of the scene; m: splats; k: coefficients per channel, (degree + 1)².  The camera's centre is subtracted in
float64; the rest runs in the scene's precision.  Splats pass in chunks that fit the cache, forward and backward.
"""

from functools import cache, partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from aaplug.core.cameras import Camera
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import EAGER, EXAMPLE_SIZE, Kernel, Kernels, once_differentiable
from aaplug.core.spherical_harmonics import sh_colour
from aaplug.core.splats import Splats2D

SPLATS_PER_CALL = 1 << 16
COMPILED_COEFFICIENTS = (4, 9, 16)  # coefficients per channel of degree 1 to 3


def shade(splats: Splats2D, scene: Gaussians, camera: Camera, kernels: Kernels = EAGER) -> Splats2D:
    """Add each splat's colour as seen from the camera: SH plus mid-grey, clamped below at black (3DGS).

    splats: at most one of each Gaussian.
    """
    centre = camera.centre.to(scene.means.device)
    columns = (scene.sh.contiguous(), scene.means.contiguous())  # once, and not for each chunk
    return splats.with_columns({"rgb": _Shade.apply(*columns, centre, splats.sources, kernels)})


class _Shade(torch.autograd.Function):
    """Colours in chunks; each writes the gradients of its own Gaussians into those of the scene."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, means: Tensor, centre: Tensor, sources: Tensor, kernels: Kernels) -> Tensor:
        ctx.save_for_backward(sh, means, centre, sources)
        ctx.kernels = kernels
        kernel = shade_kernel(sh.shape[1])
        parts = [kernels.run(kernel, sh, means, part, centre)[0] for part in sources.split(SPLATS_PER_CALL)]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        sh, means, centre, sources = ctx.saved_tensors
        kernel = gradients_kernel(sh.shape[1])
        needs = ctx.needs_input_grad[:2]
        # A gradient that nobody needs is written, but not cleared: rows that are not drawn cost nothing.
        results = [
            torch.zeros_like(x) if need else torch.empty_like(x) for x, need in zip((sh, means), needs, strict=True)
        ]
        d_centre = torch.zeros_like(centre)
        for part, grad in zip(sources.split(SPLATS_PER_CALL), grads[0].split(SPLATS_PER_CALL), strict=True):
            d_centre += ctx.kernels.run(kernel, sh, means, part, centre, grad, *results)[0]
        return *(x if need else None for x, need in zip(results, needs, strict=True)), d_centre, None, None


def _colours(
    sh: Float[Tensor, "m k 3"], means: Float[Tensor, "m 3"], centre: Float[Tensor, " 3"]
) -> Float[Tensor, "m 3"]:
    offset = (means.double() - centre).to(means)
    directions = offset / offset.square().sum(dim=1, keepdim=True).sqrt()
    return sh_colour(sh, directions).clamp(min=0.0)


def _shade(
    sh: Float[Tensor, "n k 3"], means: Float[Tensor, "n 3"], sources: Int[Tensor, " m"], centre: Float[Tensor, " 3"]
) -> tuple[Tensor]:
    return (_colours(sh.index_select(0, sources), means.index_select(0, sources), centre),)


def _gradients(
    sh: Float[Tensor, "n k 3"],
    means: Float[Tensor, "n 3"],
    sources: Int[Tensor, " m"],
    centre: Float[Tensor, " 3"],
    grad: Float[Tensor, "m 3"],
    d_sh: Float[Tensor, "n k 3"],
    d_means: Float[Tensor, "n 3"],
) -> tuple[Tensor]:
    """Write the gradients of these splats' Gaussians into `d_sh` and `d_means`; returns the camera centre's."""
    pull = torch.func.vjp(_colours, sh.index_select(0, sources), means.index_select(0, sources), centre)[1]
    of_sh, of_means, of_centre = pull(grad)
    d_sh.index_copy_(0, sources, of_sh)
    d_means.index_copy_(0, sources, of_means)
    return (of_centre,)


def _example(coefficients: int) -> tuple[Tensor, ...]:
    sh = torch.linspace(-1.0, 1.0, EXAMPLE_SIZE * coefficients * 3)
    means = torch.linspace(1.0, 2.0, EXAMPLE_SIZE * 3).view(-1, 3)
    sources = torch.arange(0, EXAMPLE_SIZE, 2)
    return sh.view(-1, coefficients, 3), means, sources, torch.zeros(3, dtype=torch.float64)


def _gradients_example(coefficients: int) -> tuple[Tensor, ...]:
    sh, means, sources, centre = _example(coefficients)
    grad = torch.linspace(-1.0, 1.0, 3 * len(sources)).view(-1, 3)
    return sh, means, sources, centre, grad, torch.zeros_like(sh), torch.zeros_like(means)


@cache
def shade_kernel(coefficients: int) -> Kernel:
    """Colours of so many coefficients per channel."""
    return Kernel(f"shade-{coefficients}", _shade, partial(_example, coefficients), ("n", "n", "m", None))


@cache
def gradients_kernel(coefficients: int) -> Kernel:
    """Gradients of these colours."""
    name, example = f"shade-{coefficients}-gradients", partial(_gradients_example, coefficients)
    sizes = ("n", "n", "m", None, "m", "n", "n")
    return Kernel(name, _gradients, example, sizes, chained=True, pulls_back=True, updates=(5, 6))
