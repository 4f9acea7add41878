"""A step with gradients by calls that trainers make of `aaplug.gsplat`, over one of colours alone."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch

import aaplug.gsplat
from aaplug.gsplat.drawing import rasterizer_of
from aaplug.rasterizers.choice import kernels_of
from aaplug.rasterizers.tiled.ahead_of_time import TRAINER_KERNELS, build
from aaplug.rendering.benchmark import synthetic_camera, synthetic_scene
from tests.bench import heading, row, timed
from tests.bench.scenes import CHECKPOINTS, trained
from tests.conftest import SHARED_DATA

PLAIN = "RGB, max_alpha 0.99"
# "depth" and "both" in a name: the loss reads the fourth channel.
CALLS: Mapping[str, Mapping[str, Any]] = {
    PLAIN: {"max_alpha": 0.99},
    "gsplat's defaults": {},
    "splatfacto's call, loss of colours": {"render_mode": "RGB+ED", "absgrad": True},
    "splatfacto's call, loss of depth, too": {"render_mode": "RGB+ED", "absgrad": True},
    "RGB+ED, loss of both": {"render_mode": "RGB+ED"},
}


def main(gaussians: int = 100_000, side: int = 800, rounds: int = 5) -> None:
    """Print milliseconds and ratios: a synthetic scene, and the chair where it is there."""
    build(names=[kernel.name for kernel in TRAINER_KERNELS])
    kernels = kernels_of(rasterizer_of("auto", torch.float32, "cpu"))
    assert all(kernels.ready(kernel) for kernel in TRAINER_KERNELS)
    scenes = {f"{gaussians:,} Gaussians": (synthetic_scene(gaussians), synthetic_camera(side, side))}
    if (SHARED_DATA / CHECKPOINTS["chair"].file).exists():
        chair = trained("chair")
        scenes["chair"] = chair.scene, chair.views()[0]
    for name, (scene, camera) in scenes.items():
        columns = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
        leaves = [column.clone().requires_grad_() for column in columns]
        intrinsics = torch.tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        view = camera.cam_from_world.float()[None], intrinsics[None], camera.width, camera.height
        draw = partial(aaplug.gsplat.rasterization, *leaves, *view, sh_degree=scene.sh_degree, packed=False)

        def step(call: str, draw: Callable[..., tuple[Any, ...]]) -> None:
            rgb = draw(**CALLS[call])[0]
            read = rgb if "depth" in call or "both" in call else rgb[..., :3]
            read.square().sum().backward()

        works: dict[str, Callable[[], object]] = {call: partial(step, call, draw) for call in CALLS}
        times = timed(works, rounds)
        heading(f"{name}, {camera.width}x{camera.height}, forward + backward", "call", "ms", f"over {PLAIN}")
        for call, seconds in times.items():
            row(call, 1e3 * seconds, seconds / times[PLAIN])
