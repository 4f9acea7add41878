"""Timing the rasterizer: stage by stage, forward and backward, beside a matrix product of this machine.

Times are medians in ms.  Machines differ and drift, so that what counts is the share of the matrix product.
"""

import math
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from aaplug.core.cameras import BLACK, Camera, look_at
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.kernels import Kernels
from aaplug.core.projection import SH_C0, project, shade
from aaplug.core.splats import drawn
from aaplug.core.training import TrainingViews
from aaplug.methods.pixel_kernels.raster_rows import drawing_of
from aaplug.methods.recipes import Recipe, find_recipe
from aaplug.rasterizers import Tiled
from aaplug.rasterizers.tiled.binning import TILE, bands
from aaplug.rasterizers.tiled.compositing import composite
from aaplug.rasterizers.tiled.counting import Counting
from aaplug.rendering.renderer import learn, render

MATRIX_SIDE = 2048
FIELD_OF_VIEW = 50.0  # degrees, of the synthetic camera
SEED = 0


@dataclass(frozen=True)
class Figures:
    """What was measured of one scene at one size.

    pairs: splat and pixel pairs that compositing evaluated.  tile_pairs: pairs in the tiles that ellipses reach.
    peak_bytes: the most memory that the process has held so far.
    """

    rasterizer: str
    gaussians: int
    width: int
    height: int
    forward_ms: float
    forward_backward_ms: float | None
    pairs: int
    tile_pairs: int
    ns_per_pair: float
    stages_ms: dict[str, float]
    peak_bytes: int
    matmul_ms: float

    @property
    def share(self) -> float:
        """Forward time over the matrix product's."""
        return self.forward_ms / self.matmul_ms

    def as_json(self) -> dict[str, Any]:
        """One JSON-ready object."""
        return {**self.__dict__, "forward_share_of_matmul": self.share}


def measure(
    scene: Gaussians,
    camera: Camera,
    rasterizer: Tiled,
    repeats: int = 5,
    backward: bool = True,
) -> Figures:
    """Time one view of a scene by the classic recipe."""
    training, recipe = learn(scene, [camera.as_trained()]), find_recipe("classic")
    camera = camera.as_trained()
    with torch.no_grad():
        stages, tile_pairs = _stages(scene, camera, rasterizer.kernels, training, recipe, repeats)
        counting = Counting(rasterizer.kernels)
        render(scene, camera, recipe, training, replace(rasterizer, kernels=counting))
        a = torch.ones(MATRIX_SIDE, MATRIX_SIDE)
        frame, product = _timed_in_turn(
            repeats, lambda: render(scene, camera, recipe, training, rasterizer), lambda: a @ a
        )
    both = None
    if backward:
        both = _timed(lambda: gradient_step(scene, camera, recipe, training, rasterizer), repeats)
    return Figures(
        rasterizer=rasterizer.kernels.name,
        gaussians=len(scene),
        width=camera.width,
        height=camera.height,
        forward_ms=frame,
        forward_backward_ms=both,
        pairs=counting.pairs,
        tile_pairs=tile_pairs,
        ns_per_pair=stages["composite"] * 1e6 / max(1, counting.pairs),
        stages_ms=stages,
        peak_bytes=_peak_bytes(),
        matmul_ms=product,
    )


def gradient_step(
    scene: Gaussians,
    camera: Camera,
    recipe: Recipe,
    training: TrainingViews,
    rasterizer: Rasterizer,
) -> dict[str, Tensor]:
    """One render, and the gradient of its mean square to everything that the scene holds."""
    names = ("means", "quats", "log_scales", "logit_opacities", "sh")
    leaves = {name: getattr(scene, name).detach().requires_grad_() for name in names}
    image = render(replace(scene, **leaves), camera, recipe, training, rasterizer, BLACK)
    grads = torch.autograd.grad(image.rgb.square().mean(), list(leaves.values()))
    return dict(zip(names, grads, strict=True))


def exponent(sizes: list[float], times: list[float]) -> float:
    """Slope of log time over log size, by least squares: 1 where cost grows linearly."""
    x = torch.tensor([math.log(size) for size in sizes], dtype=torch.float64)
    y = torch.tensor([math.log(t) for t in times], dtype=torch.float64)
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / x.square().sum())


def synthetic_camera(width: int, height: int) -> Camera:
    """The camera that looks at a synthetic scene."""
    focal = 0.5 * width / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    eye, target, up = torch.tensor([[3.6, -3.0, 1.6], [0.0, 0.0, -0.1], [0.0, 0.0, 1.0]]).double()
    pose = look_at(eye, target, up)
    return Camera("bench", width, height, focal, focal, width / 2, height / 2, pose)


def synthetic_scene(n: int, seed: int = SEED) -> Gaussians:
    """n Gaussians as trained scenes have them: flat on surfaces, overlapping alike at every n, opacities at both ends.

    A ball, the ground and a dome around them; a few needles and a few large faint ones make the tail.
    """
    draw = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=draw)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=draw)

    ball, ground = int(0.5 * n), int(0.27 * n)
    dome = n - ball - ground
    directions = torch.nn.functional.normalize(normal(n, 3), dim=1)
    on_ball = directions[:ball]
    radius, angle = 5 * uniform(ground).sqrt(), 2 * math.pi * uniform(ground)
    on_ground = torch.stack(
        [radius * angle.cos(), radius * angle.sin(), torch.full_like(radius, -1.25)], dim=1
    )
    far = 9 + 7 * uniform(dome, 1).square()
    means = torch.cat([on_ball, on_ground, directions[ball + ground :] * far])
    normals = torch.cat(
        [on_ball, torch.tensor([[0.0, 0.0, 1.0]]).repeat(ground, 1), directions[ball + ground :]]
    )
    spacing = torch.cat(
        [
            torch.full((ball,), math.sqrt(4 * math.pi / max(1, ball))),
            torch.full((ground,), math.sqrt(25 * math.pi / max(1, ground))),
            math.sqrt(4 * math.pi / max(1, dome)) * far[:, 0],
        ]
    )
    log_scales = (0.85 * spacing).log()[:, None] + 0.6 * normal(n, 3)
    log_scales[:, 2] -= 1.6  # flat along the normal
    log_scales[uniform(n) < 0.1] += torch.tensor([0.9, -0.9, 0.0])
    large = uniform(n) < 0.004
    log_scales[large] += 1.3
    opacities = torch.where(uniform(n) < 0.5, uniform(n).square(), 1 - 0.2 * uniform(n))
    opacities = torch.where(large, 0.5 * opacities, opacities).clamp(0.006, 0.998)
    sh = torch.cat([(0.5 * normal(n, 1, 3).tanh()) / SH_C0, 0.06 * normal(n, 15, 3)], dim=1)
    return Gaussians(means, _turned_to(normals, normal(n)), log_scales, opacities.logit(), sh)


def _turned_to(normals: Float[Tensor, "n 3"], roll: Float[Tensor, " n"]) -> Float[Tensor, "n 4"]:
    """Quaternions that turn z to the normals, after a roll about z."""
    x, y, z = normals.unbind(dim=1)
    # the half-way rotation from z: w = 1 + z, axis (−y, x, 0)
    w, i, j = (1 + z).clamp(min=1e-3), -y, x
    cos, sin = roll.cos(), roll.sin()
    return torch.stack([w * cos, i * cos + j * sin, j * cos - i * sin, w * sin], dim=1)


def _stages(
    scene: Gaussians,
    camera: Camera,
    kernels: Kernels,
    training: TrainingViews,
    recipe: Recipe,
    repeats: int,
) -> tuple[dict[str, float], int]:
    """Milliseconds of each stage, and the pairs of pixels and splats in the tiles that are reached."""
    times: dict[str, float] = {}

    def stage(name: str, work: Callable[[], Any]) -> Any:
        times[name] = _timed(work, repeats)
        return work()

    hw, grid = camera.hw, (-(-camera.height // TILE), -(-camera.width // TILE))
    splats = stage("project", lambda: project(scene, camera, kernels))
    splats = stage("filter", lambda: recipe.screen(splats, camera, training))
    splats = stage("cull", lambda: drawn(splats, hw, kernels=kernels))
    splats = stage("shade", lambda: shade(splats, scene, camera, kernels))
    bins = stage("bin", lambda: list(bands(splats, grid, kernels)))
    drawing = stage("forms", lambda: drawing_of(splats, kernels))
    stage("composite", lambda: [composite(drawing, band, kernels) for band in bins])
    return times, sum(int(band.counts.sum()) for band in bins) * TILE**2


def _timed(work: Callable[[], Any], repeats: int) -> float:
    """Median milliseconds, after one run that is not counted."""
    return _timed_in_turn(repeats, work)[0]


def _timed_in_turn(repeats: int, *works: Callable[[], Any]) -> list[float]:
    """Median milliseconds of each, run in turn so that a machine's moods meet all of them alike."""
    times: list[list[float]] = [[] for _ in works]
    for work in works:
        work()
    for _ in range(repeats):
        for work, mine in zip(works, times, strict=True):
            started = time.perf_counter()
            work()
            mine.append(1e3 * (time.perf_counter() - started))
    return [median(mine) for mine in times]


def _peak_bytes() -> int:
    """Linux counts in KiB, macOS in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak
