"""Scenes and cameras that tests share.

`shared_data` is a folder of real scenes that may lie beside the repository; tests that use it skip where it is absent.
"""

import logging
import math
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
import torch

from aaplug.core.cameras import Camera, CameraSet, look_at
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.io.cameras import read_cameras
from aaplug.io.scenes import read_scene
from aaplug.lab.pixel_size import PixelSizes
from aaplug.rasterizers import RASTERIZERS
from aaplug.rasterizers.tiled import Tiled
from aaplug.rasterizers.tiled.ahead_of_time import load

COMPILED = load()
ALL_RASTERIZERS: dict[str, Rasterizer] = {**RASTERIZERS, **({} if COMPILED is None else {"compiled": Tiled(COMPILED)})}

ROOT = Path(__file__).resolve().parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"
SAMPLE = Path(str(files("aaplug.io.sample")))
CLEAR_REFS = Path("/proc/self/clear_refs")
needs_peak_memory = pytest.mark.skipif(not CLEAR_REFS.exists(), reason="peak memory of a process is read from /proc")


def pytest_configure() -> None:
    """Test processes run side by side; threads that wait for each other would stall them all."""
    torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def own_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the library's log handlers after each test: the command line replaces them."""
    logger = logging.getLogger("aaplug")
    monkeypatch.setattr(logger, "handlers", list(logger.handlers))
    monkeypatch.setattr(logger, "propagate", True)


def each(entries: Mapping[str, Any]) -> Any:
    """A fixture that is each of these in turn, by name."""
    return pytest.fixture(params=entries.values(), ids=entries)(lambda request: request.param)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    if not SHARED_DATA.is_dir():
        pytest.skip("no folder of real scenes beside the repository")
    return SHARED_DATA


@pytest.fixture(scope="session")
def sample_folder() -> Path:
    return SAMPLE


@pytest.fixture(scope="session")
def sample_scene() -> Gaussians:
    return read_scene(SAMPLE / "chair.ply").gaussians()


@pytest.fixture(scope="session")
def sample_cameras() -> CameraSet:
    return read_cameras(SAMPLE)


@pytest.fixture(scope="session")
def sample_training(sample_scene: Gaussians, sample_cameras: CameraSet) -> TrainingViews:
    return TrainingViews.of(sample_scene, sample_cameras)


MEASURE = """
import torch
torch.set_num_threads(1)
{prepare}
def peak():
    words = open("/proc/self/status").read().split()
    return int(words[words.index("VmHWM:") + 1]) * 1024
open("/proc/self/clear_refs", "w").write("5")  # resets the peak, which imports raised
before = peak()
{work}
print(peak() - before)
"""


def memory_taken(prepare: str, work: str) -> int:
    """Bytes by which statements raise the peak of a fresh process; one that ran other tests has memory to reuse."""
    command = [sys.executable, "-c", MEASURE.format(prepare=prepare, work=work)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=120)
    return int(run.stdout)


def make_camera(
    eye: tuple[float, float, float] = (0.0, -4.0, 0.0),
    size: tuple[int, int] = (64, 48),
    fov: float = 0.7,
    name: str = "view",
) -> Camera:
    """A pose of the data set that looks at the origin; size is width and height in px."""
    focal = 0.5 * size[0] / math.tan(fov / 2)
    pose = look_at(torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    centre = size[0] / 2, size[1] / 2
    return Camera(name, *size, focal, focal, *centre, pose).as_trained()


def straight_camera(
    focal: float = 100.0, size: tuple[int, int] = (80, 60), centre: tuple[float, float] | None = None, back: float = 0.0
) -> Camera:
    """At (0, 0, -back), looking along +z, with x and y as in the image."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = back
    return Camera("straight", *size, focal, focal, *(centre or (size[0] / 2, size[1] / 2)), pose)


def make_scene(n: int, seed: int = 0, dtype: torch.dtype = torch.float32, degree: int = 1) -> Gaussians:
    """Random Gaussians around the origin with scales near 0.1 world units."""
    g = torch.Generator().manual_seed(seed)
    rand = {"generator": g, "dtype": torch.float64}
    return Gaussians(
        means=torch.randn(n, 3, **rand) * 0.7,
        quats=torch.randn(n, 4, **rand),
        log_scales=torch.randn(n, 3, **rand) * 0.7 - 2.5,
        logit_opacities=torch.randn(n, **rand) * 2,
        sh=torch.randn(n, (degree + 1) ** 2, 3, **rand) * 0.5,
    ).to(dtype)


def sized(scene: Gaussians, always: bool = False) -> Gaussians:
    """The scene with the pixel sizes of Multi-Scale 3DGS; in most views some Gaussians are too small or too large.

    always: every Gaussian is drawn at every size.
    """
    n = len(scene)
    base = (torch.arange(n) % 4 == 0) | always
    sizes = PixelSizes(torch.full((n,), 4.0), torch.full((n,), 8.0), base)
    return replace(scene, extras=sizes.extras)


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


def splats_of(*rows: tuple) -> Splats2D:
    """Splats of (mean, covariance, depth, opacity, colour), in float64."""
    means, covs, depths, opacities, colours = zip(*rows, strict=True)
    covs = torch.tensor(covs, dtype=torch.float64)
    return Splats2D(
        means=torch.tensor(means, dtype=torch.float64),
        covs=covs,
        dets=covs[:, 0] * covs[:, 2] - covs[:, 1].square(),
        depths=torch.tensor(depths, dtype=torch.float64),
        opacities=torch.tensor(opacities, dtype=torch.float64),
        sources=torch.arange(len(rows)),
        rgb=torch.tensor(colours, dtype=torch.float64),
    )
