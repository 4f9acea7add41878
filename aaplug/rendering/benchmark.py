"""Timing the tiled rasterizer: stage by stage, forward and backward, beside exponentials of this machine.

Times are medians in ms.  Machines differ and their speed drifts, so each frame is timed in turn with an array of
exponentials: compositing computes one in each evaluation, also with whole vectors.
"""

import math
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from statistics import linear_regression, median
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from aaplug.core.cameras import Camera, centred, look_at
from aaplug.core.ellipses import cull
from aaplug.core.gaussians import Gaussians
from aaplug.core.kernels import Kernels
from aaplug.core.projection import project
from aaplug.core.pyramids import faded
from aaplug.core.shading import shade
from aaplug.core.spherical_harmonics import SH_C0
from aaplug.methods.pixel_kernels.raster_rows import TILE
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.backward import composite
from aaplug.rasterizers.tiled.binning import bands
from aaplug.rasterizers.tiled.forward import Compositing
from aaplug.rasterizers.tiled.packages import CountingKernels
from aaplug.rendering.renderer import Renderer
from aaplug.system.cores import on_free_cores
from aaplug.system.plug_ins import filtered

DRAWN_AT_ONCE = 1 << 16  # Gaussians; a multiple of 16, so that the random numbers are those of one draw
EXPONENTIALS = 1 << 18  # at once; their array fits the cache
EXPONENTIAL_CALLS = 16
FIELD_OF_VIEW = 50.0  # degrees, of the synthetic camera


@dataclass(frozen=True)
class Figures:
    """Measurements of one scene at one size.

    gaussians: those of the scene, or of the levels of detail that the view draws.
    evaluations: splat-pixel evaluations of compositing.
    peak_bytes: the most memory that the process has used so far; None on Windows.
    calls: of torch's operators and of compiled kernels in a frame, each of which costs microseconds beside its work.
    exponential_ns: of one float32 exponential by torch, with the same threads.
    """

    rasterizer: str
    gaussians: int
    width: int
    height: int
    forward_ms: float
    forward_backward_ms: float
    evaluations: int
    ns_per_evaluation: float
    stages_ms: dict[str, float]
    peak_bytes: int | None
    calls: dict[str, int]
    exponential_ns: float

    @property
    def exponentials(self) -> float:
        """Time of a frame for each of its evaluations, in exponentials."""
        return self.forward_ms * 1e6 / max(1, self.evaluations) / self.exponential_ns

    def as_json(self) -> dict[str, Any]:
        """One JSON-ready object."""
        return {**self.__dict__, "exponentials_per_evaluation": self.exponentials}


class _Calls(TorchDispatchMode):
    """Counts the calls of torch's operators."""

    count = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.count += 1
        return func(*args, **(kwargs or {}))


@on_free_cores()
def measure(renderer: Renderer, camera: Camera, kernels: Kernels, repeats: int = 5) -> Figures:
    """Time one view, of the levels of detail that the renderer picks for it if it has any.

    kernels: run the stages, eagerly or compiled.
    """
    renderer = replace(renderer, rasterizer=Tiled(kernels))
    runs: list[tuple[int, bool]] = []  # of kernels: evaluations, and whether compiled
    with torch.no_grad():
        stages, gaussians = _stages(renderer, camera, kernels, repeats)
        counting = CountingKernels(kernels, lambda *run: runs.append(run))
        with _Calls() as operators:
            replace(renderer, rasterizer=Tiled(counting))(camera)
        numbers, results = torch.linspace(-8.0, 0.0, EXPONENTIALS), torch.empty(EXPONENTIALS)

        def exponentials() -> None:
            for _ in range(EXPONENTIAL_CALLS):
                torch.exp(numbers, out=results)

        frame, yardstick = _timed(repeats, lambda: renderer(camera), exponentials)
    evaluations = sum(count for count, _ in runs)
    [gradients] = _timed(repeats, lambda: gradient_step(renderer, camera))
    peak = None
    with suppress(ImportError):  # Windows has no such module
        import resource

        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return Figures(
        rasterizer=kernels.name,
        gaussians=gaussians,
        width=camera.width,
        height=camera.height,
        forward_ms=frame,
        forward_backward_ms=gradients,
        evaluations=evaluations,
        ns_per_evaluation=stages["composite"] * 1e6 / max(1, evaluations),
        stages_ms=stages,
        peak_bytes=peak,
        calls={"operators": operators.count, "compiled kernels": sum(compiled for _, compiled in runs)},
        exponential_ns=yardstick * 1e6 / (EXPONENTIALS * EXPONENTIAL_CALLS),
    )


def gradient_step(renderer: Renderer, camera: Camera) -> None:
    """One render, and the gradient of its mean square with respect to all parameters of the scene."""
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    leaves = {name: getattr(renderer.scene, name).detach().requires_grad_() for name in names}
    image = replace(renderer, scene=replace(renderer.scene, **leaves))(camera)
    torch.autograd.grad(image.rgb.square().mean(), list(leaves.values()))


def exponent(sizes: list[float], times: list[float]) -> float:
    """Slope of log time over log size, by least squares: 1 where cost grows linearly."""
    return linear_regression([*map(math.log, sizes)], [*map(math.log, times)]).slope


def synthetic_camera(width: int, height: int) -> Camera:
    """The camera that looks at a synthetic scene."""
    focal = 0.5 * width / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    eye, target, up = torch.tensor([[3.6, -3.0, 1.6], [0.0, 0.0, -0.1], [0.0, 0.0, 1.0]]).double()
    return centred("bench", (width, height), focal, look_at(eye, target, up))


def synthetic_scene(n: int, seed: int = 0) -> Gaussians:
    """n Gaussians as trained scenes have them: flat on surfaces, overlapping alike at every n, opacities near 0 and 1.

    A ball, the ground and a dome around them; a few needles and a few large faint ones form the tail.
    """
    draw = torch.Generator().manual_seed(seed)
    means, normals, spacing = _surfaces(n, draw)
    log_scales = (0.85 * spacing).log()[:, None] + 0.6 * torch.randn(n, 3, generator=draw)
    log_scales[:, 2] -= 1.6  # flat along the normal
    needles = torch.rand(n, generator=draw) < 0.1
    log_scales[needles] += torch.tensor([0.9, -0.9, 0.0])
    large = torch.rand(n, generator=draw) < 0.004
    log_scales[large] += 1.3
    sides = torch.rand(n, generator=draw) < 0.5
    low = torch.rand(n, generator=draw).square()
    opacities = torch.where(sides, low, 1 - 0.2 * torch.rand(n, generator=draw))
    opacities = torch.where(large, 0.5 * opacities, opacities).clamp(0.006, 0.998)
    base = 0.5 * torch.randn(n, 1, 3, generator=draw).tanh() / SH_C0
    sh = base.new_empty(n, 16, 3)
    sh[:, :1] = base
    for part in sh[:, 1:].split(DRAWN_AT_ONCE):
        part.copy_(0.06 * torch.randn(part.shape, generator=draw))
    quats = _turned_to(normals, torch.randn(n, generator=draw))
    return Gaussians(means, quats, log_scales, opacities.logit(), sh)


def _surfaces(n: int, draw: torch.Generator) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Points on a unit ball, on the ground and on a dome, their normals, and the spacing of their surface."""
    ball, ground = int(0.5 * n), int(0.27 * n)
    dome = n - ball - ground
    directions = torch.nn.functional.normalize(torch.randn(n, 3, generator=draw), dim=1)
    radius = 5 * torch.rand(ground, generator=draw).sqrt()
    angle = 2 * math.pi * torch.rand(ground, generator=draw)
    height = torch.full_like(radius, -1.25)
    on_ground = torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=1)
    far = 9 + 7 * torch.rand(dome, 1, generator=draw).square()
    outer = directions[ball + ground :]
    means = torch.cat([directions[:ball], on_ground, outer * far])
    up = torch.tensor([[0.0, 0.0, 1.0]]).repeat(ground, 1)
    normals = torch.cat([directions[:ball], up, outer])
    on_ball, on_dome = (math.sqrt(4 * math.pi / max(1, count)) for count in (ball, dome))
    flat = torch.full((ground,), math.sqrt(25 * math.pi / max(1, ground)))
    return means, normals, torch.cat([torch.full((ball,), on_ball), flat, on_dome * far[:, 0]])


def _turned_to(normals: Float[Tensor, "n 3"], roll: Float[Tensor, " n"]) -> Float[Tensor, "n 4"]:
    """Quaternions that turn z to the normals, after a roll about z."""
    x, y, z = normals.unbind(dim=1)
    w, i, j = (1 + z).clamp(min=1e-3), -y, x  # half the angle from z, about the axis (-y, x, 0)
    cos, sin = roll.cos(), roll.sin()
    return torch.stack([w * cos, i * cos + j * sin, j * cos - i * sin, w * sin], dim=1)


def _stages(renderer: Renderer, camera: Camera, kernels: Kernels, repeats: int) -> tuple[dict[str, float], int]:
    """Times of a frame's stages, as `Renderer.draw` and `Tiled` run them, and its number of Gaussians."""
    times: dict[str, float] = {}

    def stage(name: str, work: Callable[[], Any]) -> Any:
        [times[name]] = _timed(repeats, work)
        return work()

    scene, recipe, training = renderer.scene, renderer.recipe, renderer.training
    hw, grid = camera.hw, (-(-camera.height // TILE), -(-camera.width // TILE))
    how = Compositing(recipe.pixel, training.convention.rules, kernels)
    chunk, cut = scene, None
    if renderer.cutter is not None:
        cut = stage("cut", partial(renderer.cutter, camera, renderer.coarsening(camera, 1)))
        chunk = cut.of(scene)
    splats = stage("project", lambda: project(chunk, camera, kernels))
    if cut is not None:
        rows = splats.sources  # of the cut
        splats = replace(splats, sources=cut.places.index_select(0, rows))
        splats = splats if cut.shares is None else faded(splats, cut.shares.index_select(0, rows))
    splats = stage("filter", lambda: filtered("screen filter", recipe.screen, splats, camera, training))
    splats = stage("cull", lambda: cull(splats, hw, kernels=kernels))
    splats = stage("shade", lambda: shade(splats, scene, camera, kernels))
    bins = stage("bin", lambda: list(bands(splats, grid, kernels)))
    rows = stage("forms", lambda: recipe.pixel.raster_rows(splats, kernels))
    stage("composite", lambda: [composite(rows, band, how) for band in bins])
    return times, len(chunk)


def _timed(repeats: int, *works: Callable[[], Any]) -> list[float]:
    """Median milliseconds of each, run in turn so that drift of the machine affects all alike, after one run each."""
    times: list[list[float]] = [[] for _ in works]
    for work in works:
        work()
    for _ in range(repeats):
        for work, mine in zip(works, times, strict=True):
            started = time.perf_counter()
            work()
            mine.append(1e3 * (time.perf_counter() - started))
    return [median(mine) for mine in times]
