"""Scenes and cameras that tests share.

`shared_data` is a folder of real scenes that may lie beside the repository; tests that use it skip where it is absent.
"""

import logging
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
import torch

from aaplug.core.cameras import Camera, CameraSet
from aaplug.core.gaussians import Gaussians
from aaplug.core.interfaces import Rasterizer
from aaplug.core.splats import Splats2D
from aaplug.core.training import TrainingViews
from aaplug.evaluation.laws.base import make_camera as make_camera
from aaplug.evaluation.laws.base import make_scene as make_scene
from aaplug.evaluation.laws.base import make_splats as make_splats
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


def straight_camera(
    focal: float = 100.0, size: tuple[int, int] = (80, 60), centre: tuple[float, float] | None = None, back: float = 0.0
) -> Camera:
    """At (0, 0, -back), looking along +z, with x and y as in the image."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[2, 3] = back
    return Camera("straight", *size, focal, focal, *(centre or (size[0] / 2, size[1] / 2)), pose)


def sized(scene: Gaussians, always: bool = False) -> Gaussians:
    """The scene with the pixel sizes of Multi-Scale 3DGS; in most views some Gaussians are too small or too large.

    always: every Gaussian is drawn at every size.
    """
    n = len(scene)
    base = (torch.arange(n) % 4 == 0) | always
    sizes = PixelSizes(torch.full((n,), 4.0), torch.full((n,), 8.0), base)
    return replace(scene, extras=sizes.extras)


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
