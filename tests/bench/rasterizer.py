"""Frames and steps for pytest-benchmark: `pytest tests/bench/rasterizer.py -n0`."""

import os
from collections.abc import Iterator
from typing import Any

import pytest
import torch

from aaplug.core.executors import torch_threads
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.training import TrainingViews
from aaplug.methods.recipes import find_recipe
from aaplug.rendering.benchmark import gradient_step, synthetic_camera, synthetic_scene
from aaplug.rendering.renderer import Renderer
from tests.conftest import ALL_RASTERIZERS

CAMERA = synthetic_camera(800, 800).as_trained()
ROUNDS = {"rounds": 5, "warmup_rounds": 1}
RECIPE = find_recipe("classic")


@pytest.fixture(autouse=True, scope="module")
def all_threads() -> Iterator[None]:
    with torch_threads(os.cpu_count() or 1):  # tests have one
        yield


@pytest.fixture(params=["compiled", "eager"])
def rasterizer(request: pytest.FixtureRequest):
    if request.param not in ALL_RASTERIZERS:
        pytest.skip("the kernels are not compiled here (aaplug warmup)")
    return ALL_RASTERIZERS[request.param]


@pytest.fixture(params=[10_000, 100_000, 1_000_000], ids=str)
def scene(request: pytest.FixtureRequest):
    return synthetic_scene(request.param)


def test_forward(benchmark: Any, scene: Gaussians, rasterizer: Rasterizer):
    renderer = Renderer(scene, TrainingViews.of(scene, [CAMERA]), RECIPE, rasterizer)
    with torch.no_grad():
        image = benchmark.pedantic(renderer, (CAMERA,), **ROUNDS)
    assert image.alpha.mean() > 0.5


def test_forward_and_backward(benchmark: Any, scene: Gaussians, rasterizer: Rasterizer):
    renderer = Renderer(scene, TrainingViews.of(scene, [CAMERA]), RECIPE, rasterizer)
    grads = benchmark.pedantic(gradient_step, (renderer, CAMERA), **ROUNDS)
    assert all(grad.abs().sum() > 0 for grad in grads.values())
